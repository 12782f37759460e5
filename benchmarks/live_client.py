"""A client of `poise live --stream` that sends what streams should not: late, torn, doubled, swapped."""

from __future__ import annotations

import asyncio
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from websockets.asyncio.client import connect

from poise.live.sources import Loop
from poise.motion import Clip

#: s that each person stands at first.
STANDS_S = 3.0


@dataclass
class Sent:
    """What was sent, by kind."""

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
    url: str,
    clips: Sequence[Clip],
    seconds: float,
    seed: int,
    faults: bool,
    sent: Sent | None = None,
) -> Sent:
    """Sends each clip as a person at 30 Hz; counts in `sent`."""
    rng, sent, loops = np.random.default_rng(seed), sent or Sent(), [Loop(c) for c in clips]
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
