"""Live motion: four people in real time for most of an hour, endless motion, success by buffer and
noise.

`poise live` runs in a process of its own and a client in this one, which errs: drop-outs, NaN packets,
bursts, swaps. Latency is beyond the buffer. Buffers are measured by a clock of the benchmark's own,
sixteen clips at once and 20 m apart, 30 Hz, packets late and lost. Times are of the machine as it was.
The null is a server to which nobody sends.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from websockets.asyncio.client import connect

from benchmarks.common.clips import Places, clip_of, moment, names_of
from benchmarks.common.rows import Figure, mean_of, of
from benchmarks.common.runner import Part, Raws
from poise.formats.point_fit import fit_clip
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.kinematics.retargeting.keypoint_goal import PointBody
from poise.live.characters import FALLS, RETURNS
from poise.live.protocol import LiveConfig
from poise.live.session import Live
from poise.live.sources import Loop
from poise.live.stream import Packet
from poise.metrics import success_rule
from poise.motion import Clip
from poise.motion.keypoints import Keypoints
from poise.sim import difference

# --- a server and a client that errs ---------------------------------------------------------------


def serve(*argv: str) -> tuple[subprocess.Popen[str], str]:
    """`poise live` in a process of its own, and its address."""
    process = subprocess.Popen(
        [sys.executable, "-m", "poise", "live", "--port", "0", *argv],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"},
    )
    assert process.stdout is not None
    for line in process.stdout:
        if found := re.search(r"http://(\S+?)/", line):
            return process, found[1]
    raise SystemExit("poise live did not start")


def memory_mb(pid: int) -> float:
    """The memory of a process."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


#: s that each person stands at first.
STANDS_S = 3.0


@dataclass
class Told:
    """Packets that were sent, by kind."""

    counts: dict[str, int] = field(default_factory=dict)

    def add(self, kind: str) -> None:
        self.counts[kind] = self.counts.get(kind, 0) + 1


def skeleton_message(clip: Clip, person: str) -> str:
    s = clip.skeleton
    told = {"names": s.names, "parents": s.parents, "offsets": s.offsets.tolist(), "up": "Z"}
    return json.dumps({"v": 1, "type": "skeleton", "person": person, **told})


def pose_message(person: str, time_s: float, root: np.ndarray, rot: np.ndarray) -> str:
    told = {"time": time_s, "root": root.tolist(), "rotations": rot.tolist()}
    return json.dumps({"v": 1, "type": "pose", "person": person, **told})


async def play(
    url: str, clips: Sequence[Clip], seconds: float, seed: int, faults: bool, sent: Told | None = None
) -> Told:
    """Sends each clip as a person at 30 Hz; counts in `sent`."""
    rng, sent, loops = np.random.default_rng(seed), sent or Told(), [Loop(c) for c in clips]
    async with connect(url, max_size=None, ping_interval=None) as socket:
        drain = asyncio.create_task(_drain(socket))
        names = [f"p{k}" for k in range(len(clips))]
        for name, clip in zip(names, clips, strict=True):
            await socket.send(skeleton_message(clip, name))
        began, step, quiet = time.perf_counter(), 0, [0.0] * len(clips)
        while (now := time.perf_counter() - began) < seconds:
            at = step / 30
            for k, loop in enumerate(loops):
                frame = max(0, round((at - STANDS_S) * loop.clip.fps))
                who = names[k]
                if faults and at > 2 * STANDS_S:
                    if now < quiet[k]:
                        continue
                    u = rng.uniform()
                    if u < 1 / 900:
                        quiet[k] = now + rng.uniform(0.1, 3.0)
                        sent.add("drop-outs")
                    elif u < 2 / 900:
                        root, rot = loop(frame)
                        bad = rot.copy()
                        bad[rng.integers(len(bad))] = math.nan
                        await socket.send(pose_message(who, at, root, bad))
                        sent.add("NaN packets")
                    elif u < 3 / 900:
                        for _ in range(10):
                            await socket.send(pose_message(who, at, *loop(frame)))
                        sent.add("bursts of 10")
                    elif u < 3.2 / 900 and len(loops) > 1:
                        other = (k + 1) % len(loops)
                        if loops[k].clip.skeleton.same_bones(loops[other].clip.skeleton):
                            loops[k], loops[other] = loops[other], loops[k]
                            sent.add("swaps")
                await socket.send(pose_message(who, at, *loop(frame)))
                sent.add("poses")
            step += 1
            await asyncio.sleep(max(0.0, began + step / 30 - time.perf_counter()))
        drain.cancel()
    return sent


async def _drain(socket: Any) -> None:
    async for _ in socket:
        pass


async def watch(
    url: str, seconds: float, heard: Callable[[dict[str, Any]], None] | None = None
) -> list[dict[str, Any]]:
    """The figures that pages are told, about four a second.

    heard: is told them as they come, in place of keeping them.
    """
    out, end = list[dict[str, Any]](), time.perf_counter() + seconds
    heard = heard or out.append
    async with connect(url, max_size=None, ping_interval=None) as socket:
        while time.perf_counter() < end:
            try:
                told = await asyncio.wait_for(socket.recv(), 5.0)
            except TimeoutError:
                heard({"silent": True})
                continue
            if isinstance(told, str) and (said := json.loads(told)).get("type") == "figures":
                heard(said)
    return out


#: s before figures count, s after the client's end in which characters that are down may still get up.
WARMS_S, ENDS_S = 10.0, 20.0


def told(seen: Sequence[tuple[float, dict[str, Any]]], sent: Told, warms_s: float) -> dict[str, Any]:
    """Rows of the figures `(s, figures)` of a run."""
    counted = [(t, s) for t, s in seen if t > warms_s]
    if not counted:
        return {}
    last, hz = counted[-1][1], np.array([s["hz"] for _, s in counted])
    late = np.array([s["latency_ms"] for _, s in counted])
    steps = np.array([s["step_ms"] for _, s in counted])
    # s for which each character was down or on its way up, without a break.
    longest, since = [0.0] * 4, [None] * 4
    off: list[list[float]] = [[] for _ in range(4)]
    for t, s in counted:
        for k, c in enumerate(s["characters"]):
            if c["doing"] in (FALLS, RETURNS):
                since[k] = t if since[k] is None else since[k]
                longest[k] = max(longest[k], t - since[k])
            else:
                since[k] = None
                off[k].append(c["off_mm"])
    doing = Counter(c["doing"] for _, s in counted for c in s["characters"])
    return {
        "sent": dict(sent.counts),
        "refused": last["refused"],
        "hz": {
            "median": float(np.median(hz)),
            "p1": float(np.percentile(hz, 1)),
            "least": float(hz.min()),
        },
        "latency_ms_beyond_buffer": {
            "p50": float(np.median(late[:, 0])),
            "p99": float(np.median(late[:, 1])),
            "worst minute's p99": float(late[:, 1].max()),
        },
        "step_ms": {"p50": float(np.median(steps[:, 0])), "p99": float(np.median(steps[:, 1]))},
        "steps_late": last["behind"],
        "resets": last["resets"],
        "looked_ahead": last["looked_ahead"],
        "characters": [
            {
                **{n: c[n] for n in ("doing", "lost", "falls", "recovered")},
                "longest_s_down": round(longest[k], 1),
                "off_mm_median": float(np.median(off[k] or [0])),
            }
            for k, c in enumerate(last["characters"])
        ],
        "share_of_time": {k: round(v / sum(doing.values()), 4) for k, v in doing.items()},
        "unrecovered": sum(c["doing"] in (FALLS, RETURNS) for c in last["characters"]),
    }


def endure(clips: Sequence[Clip], minutes: float, seed: int, smoke: bool) -> dict[str, Any]:
    """One run."""
    seconds, four = 60 * minutes, [clips[k % len(clips)] for k in range(4)]
    process, host = serve("--stream", "--characters", "4", "--lookahead", "1", "--buffer", "0.3")
    row: dict[str, Any] = {"minutes": 0.0, "clips": [c.name for c in four], "memory_mb": []}
    seen, sent, began = list[tuple[float, dict[str, Any]]](), Told(), time.perf_counter()

    def heard(figures: dict[str, Any]) -> None:
        if "characters" in figures:
            seen.append((time.perf_counter() - began, figures))

    async def remember() -> None:
        while process.poll() is None:
            now = time.perf_counter() - began
            row["memory_mb"].append((round(now), round(memory_mb(process.pid), 1)))
            await asyncio.sleep(1 if smoke else 10)

    async def all_three() -> None:
        task = asyncio.create_task(remember())
        await asyncio.gather(
            play(f"ws://{host}/stream", four, seconds, seed, True, sent),
            watch(f"ws://{host}/live", seconds + (2.0 if smoke else ENDS_S), heard),
        )
        task.cancel()

    try:
        asyncio.run(all_three())
    finally:
        row["alive"] = process.poll() is None
        row["minutes"] = round((time.perf_counter() - began) / 60, 1)
        process.terminate()
        process.wait(30)
    return {**row, **told(seen, sent, 2.0 if smoke else WARMS_S)}


async def watched(host: str, count: int, seconds: float, warms_s: float) -> list[dict[str, Any]]:
    """Sets all characters going; the figures that pages are told from then on."""
    out, loop = list[dict[str, Any]](), asyncio.get_running_loop()
    async with connect(f"ws://{host}/live", max_size=None, ping_interval=None) as socket:
        for k in range(count):
            told = {"v": 1, "type": "dream", "character": k, "on": True}
            await socket.send(json.dumps(told))
        end = loop.time() + warms_s + seconds
        while loop.time() < end:
            told = await asyncio.wait_for(socket.recv(), 30.0)
            if isinstance(told, str) and (said := json.loads(told)).get("type") == "figures":
                out.append({**said, "s": loop.time() - end + seconds})
    return [f for f in out if f["s"] >= 0.0]


# --- buffers ---------------------------------------------------------------------------------------


BUFFERS, NOISES = (0.0, 0.033, 0.1, 0.2, 0.4), (0.0, 0.25, 0.5, 1.0)


#: s by which packets come late (deviation), and share of them that never come.
LATE_S, LOST = 0.01, 0.02


#: s of a clip that have come before its character is set down; characters at once; m between them.
FIRST_S, AT_ONCE, APART_M = 0.5, 16, 20.0


class Sent(NamedTuple):
    """A clip as packets, and when each comes."""

    clip: Clip
    packets: list[Packet]
    coming: list[tuple[float, int]]


def sent(clip: Clip, tracker: Tracker, seed: int) -> Sent:
    """Packets of a source for a clip."""
    rng, rate = np.random.default_rng(seed), clip.fps
    packets = [
        Packet("x", k / rate, clip.skeleton, clip.root_pos[k], clip.rot[k], clip)
        for k in range(clip.frames)
    ]
    if tracker.config.goal == "keypoints":
        points = Keypoints(clip.skeleton.names, clip.positions(), clip.fps, clip.name)
        body = PointBody.calibrate(points, tracker.example, tracker.humanoid.table)
        whole = fit_clip(points)
        places, root, rot = body.follow(points.positions)
        packets = [
            Packet("x", k / rate, whole.skeleton, root[k], rot[k], whole, places[k])
            for k in range(clip.frames)
        ]
    coming = sorted(
        (k / rate + abs(rng.normal(0.0, LATE_S)), k)
        for k in range(clip.frames)
        if k < 2 or rng.uniform() > LOST
    )
    return Sent(clip, packets, coming)


def moved(packet: Packet, k: int) -> Packet:
    """The packet of the k-th character, where it has room."""
    spot = APART_M * np.array([k // 4, k % 4, 0.0])
    places = None if packet.places is None else packet.places + spot
    return replace(packet, person=f"c{k}", root_pos=packet.root_pos + spot, places=places)


def streamed(live: Live, lines: list[Sent]) -> list[tuple[bool, float]]:
    """Whether each clip is done to its end, and its mean error, mm; as many as there are characters."""
    rate, world, people = live.rate_hz, live.world, live.aims.people
    people.known.clear()
    people.follows[:] = [f"c{k}" for k in range(len(lines))]
    live.aims.read_s = None
    at, now = [0] * len(lines), FIRST_S

    def send() -> None:
        for k, line in enumerate(lines):
            while at[k] < len(line.coming) and line.coming[at[k]][0] <= now:
                when, frame = line.coming[at[k]]
                live.inbox.offer(moved(line.packets[frame], k), when)
                at[k] += 1

    send()
    people.add(live.inbox.take())
    # Set down where the goals are, moving as they do, with what is known ahead of them.
    lead, frames = world.lead[0], list[torch.Tensor]()
    for back in range(lead, -1, -1):
        row = list[torch.Tensor]()
        for k, line in enumerate(lines):
            person = people.of(k)
            if person is None or not person.ready() or person.onto is None:
                raise SystemExit(f"{line.clip.name} cannot be followed")
            pose = person.buffer.read(now - (back - 1) / rate)
            assert pose is not None
            row.append(torch.from_numpy(person.onto(pose.root_pos, pose.rot)))
        frames.append(torch.stack(row))
    world.set_on(frames[0], difference(frames[1], frames[0]) * rate)
    for frame in frames[1:]:
        world.goal.push(frame)
    for character, frame in zip(world.characters, frames[-1], strict=True):
        character.follow(frame)
    before = [c.lost for c in world.characters]
    off: list[list[float]] = [[] for _ in lines]
    lost, limit = [False] * len(lines), success_rule("phc").limit_m
    while now < max(line.clip.seconds for line in lines):
        now += 1 / rate
        send()
        seen = live.step(now)
        assert seen is not None
        for k, line in enumerate(lines):
            if now <= line.clip.seconds and not lost[k]:
                off[k].append(1000.0 * float(seen.off_m[k]))
                lost[k] = world.characters[k].lost > before[k] or seen.off_m[k] > limit
    return [(not lost[k], float(np.mean(off[k]))) for k in range(len(lines))]


# --- parts ----------------------------------------------------------------------------------------


def people(places: Places, count: int = 4) -> list[Clip]:
    """Clips that people do, spread over Bandai's."""
    names = names_of(places, "bandai")
    return [clip_of(places, "bandai", names[k * len(names) // count]) for k in range(count)]


def endured(places: Places, unit: str) -> Any:
    """Four people for fifty minutes; one character looks ahead."""
    clips = [moment()] * 4 if places.smoke else people(places)
    return endure(clips, 0.12 if places.smoke else 50.0, int(unit.removeprefix("seed ")), places.smoke)


def endured_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Means over runs."""
    rows = [r for r in raws.values() if "hz" in r]
    if not rows:
        return
    everyone = [c for r in rows for c in r["characters"]]
    values = {
        "latency_p50_ms": mean_of(r["latency_ms_beyond_buffer"]["p50"] for r in rows),
        "latency_p99_ms": mean_of(r["latency_ms_beyond_buffer"]["p99"] for r in rows),
        "hz": mean_of(r["hz"]["median"] for r in rows),
        "hz_least": min(r["hz"]["least"] for r in rows),
        "steps_late": sum(r["steps_late"] for r in rows),
        "minutes": sum(r["minutes"] for r in rows),
        "losses": sum(c["lost"] for c in everyone),
        "came_back": sum(c["recovered"] for c in everyone),
        "longest_down_s": max(c["longest_s_down"] for c in everyone),
        "tracks": mean_of(r["share_of_time"].get("tracks", 0.0) for r in rows),
        "memory_mb": max(m for r in rows for _, m in r["memory_mb"]),
        "crashes": sum(not r["alive"] for r in rows),
        "unrecovered": sum(r["unrecovered"] for r in rows),
    }
    yield from of("four people, otherwise free cores", values, 4 * len(rows), seeds=len(rows))


def idle(places: Places, unit: str) -> Any:
    """A server to which nobody sends: its rate and memory."""
    process, host = serve("--characters", "1")
    try:
        seen = asyncio.run(watch(f"ws://{host}/live", 3.0 if places.smoke else 60.0))
        figures = [f for f in seen if "characters" in f]
        memory = memory_mb(process.pid)
    finally:
        process.terminate()
        process.wait(30)
    return {
        "hz": float(np.median([f["hz"] for f in figures])),
        "memory_mb": memory,
        "falls": figures[-1]["characters"][0]["falls"],
    }


def idle_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """As it was measured."""
    yield from of("nobody sends", raws["idle"], 1)


#: Characters, and cores that the server may use.
DREAMS = ((1, 1), (4, 2))


def dreamt(places: Places, unit: str) -> Any:
    """Endless motion in real time; all characters look ahead as far as there is time."""
    n, cores = (int(x) for x in re.findall(r"\d+", unit))
    every = None
    if hasattr(os, "sched_setaffinity"):
        every = os.sched_getaffinity(0)
        # What is started now inherits it; the client goes back to all of them.
        os.sched_setaffinity(0, sorted(every)[:cores])
    process, host = serve("--characters", str(n), "--lookahead", str(n), "--buffer", "0.4")
    if every is not None:
        os.sched_setaffinity(0, every)
    try:
        seen = asyncio.run(
            watched(host, n, 2.0 if places.smoke else 180.0, 1.0 if places.smoke else WARMS_S)
        )
    finally:
        process.terminate()
        process.wait(30)
    first, last = seen[0], seen[-1]
    seconds = max(1e-9, last["s"] - first["s"])
    doing = [c["doing"] for f in seen for c in f["characters"]]
    counted = {
        name: sum(
            b[name] - a[name] for a, b in zip(first["characters"], last["characters"], strict=True)
        )
        for name in ("lost", "falls", "recovered")
    }
    return {
        "minutes": seconds / 60,
        "hz": float(np.median([f["hz"] for f in seen])),
        "steps_late": last["behind"] - first["behind"],
        "looked_ahead": last["looked_ahead"],
        **counted,
        "falls_per_hour": 3600 * counted["falls"] / (n * seconds),
        "share_away": sum(d in (FALLS, RETURNS) for d in doing) / len(doing),
    }


def dream_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """As it was measured."""
    for unit, raw in raws.items():
        yield from of(unit, raw, int(re.findall(r"\d+", unit)[0]))


def buffer_units(places: Places, policy: str) -> list[str]:
    """Lengths and noises."""
    pairs = [(b, n) for n in NOISES for b in BUFFERS]
    some = pairs[2:3] if places.smoke else pairs
    return [f"buffer {1000 * b:.0f} ms, noise {n:g}" for b, n in some]


@cache
def streams(places: Places, policy: str) -> tuple[Live, list[Sent]]:
    """A session and what is sent to it; 32 clips of up to 30 s."""
    tracker = open_run(None if policy == "tracker" else policy).tracker
    clips = (
        [moment(seconds=2.5)]
        if places.smoke
        else [c for c in people(places, 32) if 1.0 < c.seconds <= 30.0]
    )
    lines = [sent(clip, tracker, k) for k, clip in enumerate(sorted(clips, key=lambda c: c.seconds))]
    many = 1 if places.smoke else AT_ONCE
    return Live(tracker, LiveConfig(many, seed=0), clock=lambda: 0.0), lines


def buffered(places: Places, unit: str, policy: str) -> Any:
    """All clips with one buffer and noise."""
    live, lines = streams(places, policy)
    length, noise = (float(x) for x in re.findall(r"[\d.]+", unit))
    live.aims.noise, live.aims.rng = noise, np.random.default_rng(0)
    live.aims.people.delay(length / 1000)
    live.aims.set_lead()
    came, many = (
        list[tuple[bool, float]](),
        len(live.world.characters),
    )
    for first in range(0, len(lines), many):
        part = lines[first : first + many]
        came += streamed(live, part + lines[: many - len(part)])[: len(part)]
    return came


def buffered_rows(places: Places, raws: Raws, policy: str) -> Iterator[Figure]:
    """Shares and errors."""
    for unit, came in raws.items():
        name = unit if policy == "tracker" else f"{unit}, policy of keypoints"
        values = {
            "done": mean_of(float(won) for won, _ in came),
            "off_mm": mean_of(e for won, e in came if won),
        }
        yield from of(name, values, len(came))


PARTS = {
    "endure": Part(
        "four people for fifty minutes",
        lambda p: [f"seed {s}" for s in range(1 if p.smoke else 3)],
        endured,
        endured_rows,
        ("tracker",),
        alone=True,
        hours=2.5,
    ),
    "idle": Part(
        "a server to which nobody sends",
        lambda _: ["idle"],
        idle,
        idle_rows,
        ("tracker",),
        alone=True,
        hours=0.02,
        needs=(),
    ),
    "dream": Part(
        "endless motion in real time",
        lambda p: [f"{n} dreaming, {c} cores" for n, c in DREAMS[: 1 if p.smoke else None]],
        dreamt,
        dream_rows,
        ("tracker", "generator"),
        alone=True,
        hours=0.1,
        needs=(),
    ),
    "buffers": Part(
        "success by buffer and noise",
        partial(buffer_units, policy="tracker"),
        partial(buffered, policy="tracker"),
        partial(buffered_rows, policy="tracker"),
        ("tracker",),
        hours=0.5,
    ),
    "buffers, keypoints": Part(
        "the same by the policy of keypoints",
        partial(buffer_units, policy="keypoints"),
        partial(buffered, policy="keypoints"),
        partial(buffered_rows, policy="keypoints"),
        ("keypoints",),
        hours=0.5,
    ),
}
