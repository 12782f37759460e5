"""Live motion: the loop by a clock of its own, and strangers.

    python benchmarks/live.py loop --minutes 50 --data FOLDER --json benchmarks/live_loop.json
    python benchmarks/live.py strangers --json benchmarks/live_strangers.json

FOLDER holds motion files of persons. Success by the length of the buffer, and torn messages:
`live_buffers.py` and `live_fuzz.py`; in real time: `live_endure.py`; in browsers: `live_page.py`.
Times are of the machine as it was: where others work on it they are upper bounds.
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
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from live_client import Sent, watch
from speed import machine

from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.live.characters import FALLS, RETURNS
from poise.live.protocol import LiveConfig
from poise.live.session import Live
from poise.live.sources import Loop, packet_of
from poise.motion import Clip


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


def loop(
    clips: Sequence[Clip], minutes: float, wall: float, seed: int, ahead: int, buffer: float, out: Path
) -> dict[str, Any]:
    """The same four people and faults by a clock of its own, which waits for nobody: the processor's
    time of each step is that of the loop alone, however busy the machine is. What it has come to is
    written every simulated minute."""
    rng, now, sent = np.random.default_rng(seed), 0.0, Sent()
    pool, began = ThreadPoolExecutor(1), time.monotonic()
    live = Live(
        open_run(None).tracker,
        LiveConfig(4, buffer, ahead, seed=seed), executor=pool, clock=lambda: now,
    )  # fmt: skip
    loops, quiet = [Loop(clips[k % len(clips)]) for k in range(4)], [0.0] * 4
    spent, held = list[float](), list[tuple[float, float]]()
    since, longest = [0.0] * 4, 0.0

    def told() -> dict[str, Any]:
        last = live.figures()
        return {
            "machine": machine(), "simulated_minutes": round(now / 60, 1), "characters": 4, "seed": seed,
            "wall_minutes": round((time.monotonic() - began) / 60, 1),
            "clips": [loops[k].clip.name for k in range(4)],
            "lookahead": ahead, "looked_ahead": last["looked_ahead"], "buffer_s": buffer,
            "sent": sent.counts, "refused": last["refused"],
            "step_cpu_ms": {
                f"p{p}": round(float(np.percentile(spent, p)), 1) for p in (50, 90, 99, 99.9)
            },
            "resets": last["resets"], "longest_s_until_it_was_back": round(longest, 1),
            "doing": [
                {n: c[n] for n in ("doing", "lost", "falls", "recovered")} for c in last["characters"]
            ],
            "memory_mb": held,
        }  # fmt: skip

    while now < 60 * minutes and time.monotonic() - began < 60 * wall:
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
        step = time.thread_time()
        live.step(now)
        spent.append(1000 * (time.thread_time() - step))
        now += 1 / 30
        for k, character in enumerate(live.world.characters):
            since[k] = since[k] + 1 / 30 if character.doing in (FALLS, RETURNS) else 0.0
            longest = max(longest, since[k])
        if frame % 900 == 0:
            held.append((round(now), round(memory_mb(os.getpid()), 1)))
        if frame % 1800 == 1799:
            out.write_text(json.dumps(told(), indent=1) + "\n")
    last = told()
    live.close()
    pool.shutdown()
    return last


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
    parser.add_argument("what", choices=("loop", "strangers"))
    parser.add_argument("--data", type=Path)
    parser.add_argument("--clips", type=int, default=24)
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--wall", type=float, default=60.0, help="minutes after which loop ends anyhow")
    parser.add_argument("--lookahead", type=int, default=1)
    parser.add_argument("--buffer", type=float, default=0.3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, required=True)
    o = parser.parse_args()
    torch.set_num_threads(1)
    if o.what == "loop":
        clips = clips_of(o.data, o.clips)
        found = loop(clips, o.minutes, o.wall, o.seed, o.lookahead, o.buffer, o.json)
    else:
        found = strangers()
    o.json.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1)[:4000])


if __name__ == "__main__":
    main()
