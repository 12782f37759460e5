"""Live motion: for how long, how late, with how short a buffer, and against strangers.

    python benchmarks/live.py endure --minutes 8 --data FOLDER --json benchmarks/live_endure.json
    python benchmarks/live.py loop --minutes 50 --data FOLDER --json benchmarks/live_loop.json
    python benchmarks/live.py buffers --data FOLDER --clips 24 --json benchmarks/live_buffers.json
    python benchmarks/live.py fuzz --count 100000 --json benchmarks/live_fuzz.json
    python benchmarks/live.py strangers --json benchmarks/live_strangers.json

FOLDER holds motion files of persons (CMU for the first, Bandai for the second). Times are of the machine
as it was: where others work on it they are upper bounds.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from live_client import Sent, play, watch
from speed import machine

from poise.jobs.open import open_run
from poise.live.commands import command, parse
from poise.live.loop import Live, LiveConfig
from poise.live.packet import Inbox
from poise.live.sinks.vmc import datagram
from poise.live.sources.file import Loop, packet_of
from poise.live.sources.stream import JsonStream
from poise.live.sources.vmc import VmcSource
from poise.live.vrm import standard
from poise.metrics import success_rule
from poise.motion import Clip, read_clip
from poise.sim import difference

BUFFERS = (0.0, 0.033, 0.1, 0.2, 0.4)
#: s by which packets come late (deviation), and share of them that never come.
LATE_S, LOST = 0.01, 0.02
#: s of a clip that have come before its character is set down.
FIRST_S = 0.5


def serve(*argv: str) -> tuple[subprocess.Popen[str], str]:
    """`poise live` in a process of its own, and its address."""
    process = subprocess.Popen(
        [sys.executable, "-m", "poise", "live", "--port", "0", *argv],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    assert process.stdout is not None
    for line in process.stdout:
        if found := re.search(r"http://(\S+?)/", line):
            return process, found[1]
    raise SystemExit("poise live did not start")


def memory_mb(pid: int) -> float:
    """What a process holds."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def endure(
    clips: Sequence[Clip], minutes: float, seed: int, ahead: int, buffer: float
) -> dict[str, Any]:
    """Four people of a client that errs, for some minutes."""
    seconds, four = 60 * minutes, [clips[k % len(clips)] for k in range(4)]
    process, host = serve(
        "--stream", "--characters", "4", "--lookahead", str(ahead), "--buffer", str(buffer)
    )
    held: list[tuple[float, float]] = []

    async def both() -> tuple[Any, list[dict[str, Any]]]:
        async def remember() -> None:
            began = time.perf_counter()
            while True:
                held.append((round(time.perf_counter() - began), round(memory_mb(process.pid), 1)))
                await asyncio.sleep(10)

        task = asyncio.create_task(remember())
        out = await asyncio.gather(
            play(f"ws://{host}/stream", four, seconds, seed, True),
            watch(f"ws://{host}/live", seconds + 15),
        )
        task.cancel()
        return out[0], out[1]

    try:
        sent, seen = asyncio.run(both())
    finally:
        alive = process.poll() is None
        process.terminate()
        process.wait(30)
    seen = [s for s in seen if "characters" in s]
    last, hz = seen[-1], [s["hz"] for s in seen[40:]]
    late = np.array([s["latency_ms"] for s in seen[40:]])
    off = [[s["characters"][k]["off_mm"] for s in seen[40:]] for k in range(4)]
    return {
        "machine": machine(), "minutes": minutes, "alive": alive, "sent": sent.counts,
        "lookahead": ahead, "buffer_s": buffer,
        "hz": {"median": float(np.median(hz)), "least": float(np.min(hz))},
        "latency_ms_beyond_buffer": {
            "p50": float(np.median(late[:, 0])), "p99": float(np.median(late[:, 1])),
            "worst p99": float(late[:, 1].max()),
        },
        "step_ms": last["step_ms"], "steps_late": last["behind"], "refused": last["refused"],
        "resets": last["resets"],
        "looked_ahead": last["looked_ahead"],
        "characters": [
            {**{n: c[n] for n in ("doing", "lost", "falls", "recovered")},
             "off_mm_median": float(np.median(o))}
            for c, o in zip(last["characters"], off, strict=True)
        ],
        "unrecovered": sum(c["doing"] in ("falls", "gets up") for c in last["characters"]),
        "memory_mb": held,
    }  # fmt: skip


def loop(
    clips: Sequence[Clip], minutes: float, wall: float, seed: int, ahead: int, buffer: float
) -> dict[str, Any]:
    """The same four people and faults by a clock of its own, which waits for nobody: the processor's
    time of each step is that of the loop alone, however busy the machine is."""
    rng, now, sent = np.random.default_rng(seed), 0.0, Sent()
    live = Live(
        open_run(None).tracker,
        LiveConfig(4, buffer, ahead, seed=seed), clock=lambda: now,
    )  # fmt: skip
    loops, quiet = [Loop(clips[k % len(clips)]) for k in range(4)], [0.0] * 4
    spent, held, ends = list[float](), list[tuple[float, float]](), time.monotonic() + 60 * wall
    while now < 60 * minutes and time.monotonic() < ends:
        frame = round(now * 30)
        for k in range(4):
            packet = packet_of(f"p{k}", loops[k], round(frame / 30 * loops[k].clip.fps))
            u = rng.uniform()
            if now < quiet[k]:
                continue
            if u < 1 / 900:
                quiet[k] = now + rng.uniform(0.1, 3.0)
                sent.add("drop-outs")
            elif u < 2 / 900:
                bad = packet.rot.copy()
                bad[rng.integers(len(bad))] = np.nan
                live.inbox.offer(replace(packet, rot=bad), now)
                sent.add("NaN packets")
            elif u < 3 / 900:
                for _ in range(10):
                    live.inbox.offer(packet, now)
                sent.add("bursts of 10")
            elif u < 3.2 / 900:
                loops[k], loops[k - 1] = loops[k - 1], loops[k]
                sent.add("swaps")
            live.inbox.offer(packet, now)
            sent.add("poses")
        began = time.process_time()
        live.step(now)
        spent.append(1000 * (time.process_time() - began))
        now += 1 / 30
        if frame % 900 == 0:
            held.append((round(now), round(memory_mb(os.getpid()), 1)))
    last = live.figures()
    live.close()
    return {
        "machine": machine(), "simulated_minutes": round(now / 60, 1), "characters": 4,
        "lookahead": ahead, "buffer_s": buffer, "sent": sent.counts, "refused": last["refused"],
        "step_cpu_ms": {f"p{p}": round(float(np.percentile(spent, p)), 1) for p in (50, 90, 99)},
        "resets": last["resets"],
        "doing": [
            {n: c[n] for n in ("doing", "lost", "falls", "recovered")} for c in last["characters"]
        ],
        "memory_mb": held,
    }  # fmt: skip


def streamed(live: Live, clip: Clip, seed: int) -> tuple[float | None, float]:
    """The s at which a clip that is streamed is lost, None if it is not, and the mean error, mm."""
    rng, loop, rate = np.random.default_rng(seed), Loop(clip), live.rate_hz
    live.people.known.clear()
    live.people.follows[0] = None
    world, character = live.world, live.world.characters[0]
    # The packets by when they come.
    coming = sorted(
        (k / clip.fps + abs(rng.normal(0.0, LATE_S)), k)
        for k in range(clip.frames) if k < 2 or rng.uniform() > LOST
    )  # fmt: skip
    now, at, off = FIRST_S, 0, list[float]()
    while at < len(coming) and coming[at][0] <= now:
        live.inbox.offer(packet_of("x", loop, coming[at][1]), coming[at][0])
        at += 1
    live.people.add(live.inbox.take())
    person = live.people.of(0)
    if person is None or not person.ready() or person.onto is None:
        raise SystemExit(f"{clip.name} cannot be followed")
    # Set down where the goal is, moving as it does, with what is known ahead of it.
    frames = list[torch.Tensor]()
    for k in range(world.lead[0], -1, -1):
        pose = person.buffer.read(now - (k - 1) / rate)
        assert pose is not None
        frames.append(torch.from_numpy(person.onto(pose.root_pos, pose.rot)))
    world.set_on(frames[0][None], difference(frames[1][None], frames[0][None]) * rate)
    for frame in frames[1:]:
        world.goal.push(frame[None])
    character.follow(frames[-1])
    before = character.lost
    while now < clip.seconds:
        now += 1 / rate
        while at < len(coming) and coming[at][0] <= now:
            live.inbox.offer(packet_of("x", loop, coming[at][1]), coming[at][0])
            at += 1
        seen = live.step(now)
        assert seen is not None
        off.append(float(seen.off_m[0]) * 1000.0)
        if character.lost > before or off[-1] > success_rule("phc").limit_m * 1000.0:
            return now, float(np.mean(off))
    return None, float(np.mean(off))


def buffers(clips: Sequence[Clip], noises: Sequence[float], seed: int) -> dict[str, Any]:
    """Success by the length of the buffer, the policy alone, without help."""
    tracker, rows = open_run(None).tracker, list[dict[str, Any]]()
    for noise in noises:
        for length in BUFFERS:
            clock = _Clock()
            live = Live(tracker, LiveConfig(buffer_s=length, noise=noise, seed=seed), clock=clock)
            done = [streamed(live, clip, seed + k) for k, clip in enumerate(clips)]
            live.close()
            won = [lost is None for lost, _ in done]
            rows.append({
                "buffer_ms": round(1000 * length), "noise": noise, "clips": len(clips),
                "success": round(float(np.mean(won)), 3),
                "off_mm": round(float(np.mean([e for lost, e in done if lost is None] or [0])), 1),
                "lost": [c.name for c, w in zip(clips, won, strict=True) if not w],
            })  # fmt: skip
            print(rows[-1], flush=True)
    how = f"30 Hz, packets {1000 * LATE_S:.0f} ms late (deviation), {100 * LOST:.0f} % lost"
    return {"stream": how, "seed": seed, "clips": [c.name for c in clips], "rows": rows}


class _Clock:
    """A clock for times that nothing depends on."""

    def __call__(self) -> float:
        return 0.0


def fuzz(count: int, seed: int) -> dict[str, Any]:
    """Messages that are torn, swapped and made up, at each door; what is left must be a pose."""
    rng, out = np.random.default_rng(seed), {}
    skeleton = standard()
    rot = np.tile([1.0, 0, 0, 0], (len(skeleton), 1))
    whole = datagram(skeleton, np.array([0.0, 0, 0.8]), rot, 1.0)
    told = {
        "v": 1,
        "type": "pose",
        "person": "a",
        "time": 1.0,
        "root": [0, 0, 0.8],
        "rotations": rot.tolist(),
    }
    pose = json.dumps(told).encode()
    push = json.dumps(
        {"v": 1, "type": "pull", "character": 0, "body": 1, "point": [0, 0, 0], "to": [0, 0, 1]}
    )
    doors = {"vmc": whole, "stream": pose, "commands": push.encode()}
    for door, like in doors.items():
        box = Inbox()
        vmc = VmcSource("127.0.0.1", 0, box, lambda: 0.0) if door == "vmc" else None
        stream = JsonStream(box)
        s = skeleton
        stream.receive(json.dumps({
            "v": 1, "type": "skeleton", "person": "a", "names": s.names, "parents": s.parents,
            "offsets": s.offsets.tolist(),
        }), 0.0)  # fmt: skip
        refused, began = 0, time.perf_counter()
        for _ in range(count):
            data = _torn(like, rng)
            if vmc is not None:
                vmc.receive(data, ("x", int(rng.integers(3))))
            elif door == "stream":
                stream.receive(data, 0.0)
            else:
                try:
                    command(parse(data))
                except Exception as problem:
                    if type(problem).__name__ != "PoiseError":
                        raise
                    refused += 1
            for line in box.take().values():
                for _, packet in line:
                    assert np.isfinite(packet.root_pos).all() and np.isfinite(packet.rot).all()
        if vmc is not None:
            vmc.close()
        out[door] = {
            "messages": count, "refused": refused or sum(box.refused.values()), "taken": box.received,
            "reasons": dict(box.refused.most_common(8)),
            "seconds": round(time.perf_counter() - began, 1),
        }  # fmt: skip
    return out


def _torn(data: bytes, rng: np.random.Generator) -> bytes:
    kind = rng.integers(4)
    if kind == 0:
        return rng.bytes(int(rng.integers(0, 200)))
    out = bytearray(data if kind < 3 else data[: rng.integers(1, len(data))])
    for at in rng.integers(0, len(out), rng.integers(0, 4)):
        out[at] = rng.integers(256)
    return bytes(out)


def strangers() -> dict[str, Any]:
    """What others try while a character walks."""
    process, host = serve("--seconds", "120")
    name, port = host.split(":")

    def ask(head: str, wait: float = 3.0) -> str:
        with socket.create_connection((name, int(port)), 5) as s:
            s.settimeout(wait)
            s.sendall(head.encode())
            return s.recv(400).decode("latin-1").split("\r\n")[0]

    upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    upgrade += "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
    out: dict[str, Any] = {
        "path traversal": ask(f"GET /../../etc/passwd HTTP/1.1\r\nHost: {host}\r\n\r\n"),
        "encoded traversal": ask(f"GET /%2e%2e/%2e%2e/etc/passwd HTTP/1.1\r\nHost: {host}\r\n\r\n"),
        "another origin": ask(f"GET /live HTTP/1.1\r\nHost: {host}\r\nOrigin: http://evil.example\r\n{upgrade}\r\n"),
        "another host": ask("GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n"),
        "POST": ask(f"POST / HTTP/1.1\r\nHost: {host}\r\nContent-Length: 0\r\n\r\n"),
    }  # fmt: skip

    async def flood() -> dict[str, Any]:
        task = asyncio.create_task(watch(f"ws://{host}/live", 25))
        await asyncio.sleep(5)
        found: dict[str, Any] = {}
        with socket.create_connection((name, int(port)), 5) as s:
            s.sendall(f"GET /stream HTTP/1.1\r\nHost: {host}\r\n{upgrade}\r\n".encode())
            await asyncio.sleep(0.3)
            s.recv(4096)
            # The head of a frame of 1 GB; what follows is never read.
            s.sendall(b"\x81\xff" + (2**30).to_bytes(8, "big") + bytes(4) + b"x" * 10_000)
            await asyncio.sleep(0.5)
            end = s.recv(4096)
            code = int.from_bytes(end[2:4], "big") if end[:1] == b"\x88" else 0
            found["a message of 1 GB"] = f"closed with {code}" if code else "taken"
        made, refused = list[socket.socket](), 0
        for _ in range(10_000):
            s = socket.socket()
            s.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                s.connect((name, int(port)))
            made.append(s)
            if len(made) % 200 == 0:
                await asyncio.sleep(0.05)
                for old in made:
                    with contextlib.suppress(OSError):
                        refused += bool(old.recv(200).startswith(b"HTTP/1.1 503"))
                    old.close()
                made.clear()
        found["10,000 connections, refusals that the client waited for"] = refused
        seen = [f for f in await task if "characters" in f]
        found["meanwhile"] = {
            "hz before": seen[8]["hz"], "hz after": seen[-1]["hz"],
            "steps late": seen[-1]["behind"] - seen[8]["behind"],
            "falls": seen[-1]["characters"][0]["falls"], "strangers": seen[-1]["strangers"],
        }  # fmt: skip
        return found

    try:
        out |= asyncio.run(flood())
        out["alive"] = process.poll() is None
    finally:
        process.terminate()
        process.wait(30)
    return out


def clips_of(folder: Path, most: int, longest_s: float = 30.0) -> list[Clip]:
    """Clips of a folder, spread evenly."""
    paths = sorted(p for p in folder.rglob("*") if p.suffix in (".bvh", ".glb", ".amc"))
    picks = [paths[k * len(paths) // min(most, len(paths))] for k in range(min(most, len(paths)))]
    return [c for p in picks if (c := read_clip(p)).seconds <= longest_s]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("endure", "loop", "buffers", "fuzz", "strangers"))
    parser.add_argument("--data", type=Path)
    parser.add_argument("--clips", type=int, default=24)
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--wall", type=float, default=60.0, help="minutes after which loop ends anyhow")
    parser.add_argument("--lookahead", type=int, default=1)
    parser.add_argument("--buffer", type=float, default=0.3)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0])
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, required=True)
    o = parser.parse_args()
    torch.set_num_threads(1)
    if o.what == "endure":
        found = endure(clips_of(o.data, o.clips), o.minutes, o.seed, o.lookahead, o.buffer)
    elif o.what == "loop":
        found = loop(clips_of(o.data, o.clips), o.minutes, o.wall, o.seed, o.lookahead, o.buffer)
    elif o.what == "buffers":
        found = buffers(clips_of(o.data, o.clips), o.noise, o.seed)
    elif o.what == "fuzz":
        found = fuzz(o.count, o.seed)
    else:
        found = strangers()
    o.json.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1)[:4000])


if __name__ == "__main__":
    main()
