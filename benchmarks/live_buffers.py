"""Success of live motion by the length of the buffer and the noise, the policy alone, without help.

    python benchmarks/live_buffers.py --data FOLDER --clips 32 --json benchmarks/live_buffers.json
    python benchmarks/live_buffers.py --policy keypoints --data FOLDER --clips 32 --json OUT.json

Clips are streamed at 30 Hz by a clock of the benchmark's own, sixteen at once and 20 m apart. A policy
of keypoints is told places of joints, the other one rotations. Rows that stand in the JSON already are
not measured again.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from speed import machine

from poise.formats import read_clip
from poise.formats.point_fit import fit_clip
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.kinematics.retarget.keypoint_goal import PointBody
from poise.live.protocol import LiveConfig
from poise.live.session import Live
from poise.live.stream import Packet
from poise.metrics import success_rule
from poise.motion import Clip
from poise.motion.keypoints import Keypoints
from poise.sim import difference

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
    """What a source sends of a clip."""
    rng, rate = np.random.default_rng(seed), clip.fps
    packets = [
        Packet("x", k / rate, clip.skeleton, clip.root_pos[k], clip.rot[k], clip)
        for k in range(clip.frames)
    ]
    if tracker.config.goal == "keypoints":
        points = Keypoints(clip.skeleton.names, clip.positions(), clip.fps, clip.name)
        body = PointBody.calibrate(points, tracker.example, tracker.humanoid.table)
        whole = fit_clip(points)
        places, root, rot = (x.numpy() for x in body.follow(points.positions))
        packets = [
            Packet("x", k / rate, whole.skeleton, root[k], rot[k], whole, places[k])
            for k in range(clip.frames)
        ]
    coming = sorted(
        (k / rate + abs(rng.normal(0.0, LATE_S)), k)
        for k in range(clip.frames) if k < 2 or rng.uniform() > LOST
    )  # fmt: skip
    return Sent(clip, packets, coming)


def moved(packet: Packet, k: int) -> Packet:
    """The packet of the k-th character, where it has room."""
    spot = APART_M * np.array([k // 4, k % 4, 0.0])
    places = None if packet.places is None else packet.places + spot
    return replace(packet, person=f"c{k}", root_pos=packet.root_pos + spot, places=places)


def streamed(live: Live, lines: list[Sent]) -> list[tuple[bool, float]]:
    """Whether each clip is done to its end, and its mean error, mm; as many as there are characters."""
    rate, world, people = live.rate_hz, live.world, live.people
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


def clips_of(folder: Path, most: int, longest_s: float = 30.0) -> list[Clip]:
    """Clips of a folder, spread evenly, the short ones first."""
    paths = sorted(p for p in folder.rglob("*") if p.suffix in (".bvh", ".glb", ".amc"))
    picks = [paths[k * len(paths) // min(most, len(paths))] for k in range(min(most, len(paths)))]
    clips = [c for p in picks if FIRST_S + 0.5 < (c := read_clip(p)).seconds <= longest_s]
    return sorted(clips, key=lambda c: c.seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--policy")
    parser.add_argument("--clips", type=int, default=32)
    parser.add_argument("--noise", type=float, nargs="+", default=list(NOISES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, required=True)
    o = parser.parse_args()
    torch.set_num_threads(1)
    tracker = open_run(o.policy).tracker
    clips = clips_of(o.data, o.clips)
    lines = [sent(clip, tracker, o.seed + k) for k, clip in enumerate(clips)]
    how = f"30 Hz, packets {1000 * LATE_S:.0f} ms late (deviation), {100 * LOST:.0f} % lost"
    out: dict[str, Any] = {
        "machine": machine(), "policy": o.policy or "tracker", "stream": how, "seed": o.seed,
        "clips": [c.name for c in clips], "rows": [],
    }  # fmt: skip
    if o.json.exists() and (known := json.loads(o.json.read_text())).get("clips") == out["clips"]:
        out["rows"] = [r for r in known["rows"] if known["policy"] == out["policy"]]
    done = {(r["buffer_ms"], r["noise"]) for r in out["rows"]}
    live = Live(tracker, LiveConfig(AT_ONCE, seed=o.seed), clock=lambda: 0.0)
    for noise in o.noise:
        for length in BUFFERS:
            if (round(1000 * length), noise) in done:
                continue
            live.aims.noise, live.aims.rng = noise, np.random.default_rng(o.seed)
            live.people.delay(length)
            live.aims.set_lead()
            came = list[tuple[bool, float]]()
            for first in range(0, len(lines), AT_ONCE):
                part = lines[first : first + AT_ONCE]
                whole = part + lines[: AT_ONCE - len(part)]
                came += streamed(live, whole)[: len(part)]
            won = [w for w, _ in came]
            out["rows"].append({
                "buffer_ms": round(1000 * length), "noise": noise, "clips": len(clips),
                "success": round(float(np.mean(won)), 3),
                "off_mm": round(float(np.mean([e for w, e in came if w] or [0])), 1),
                "lost": [c.name for c, w in zip(clips, won, strict=True) if not w],
            })  # fmt: skip
            o.json.write_text(json.dumps(out, indent=1) + "\n")
            print(json.dumps(out["rows"][-1])[:120], flush=True)
    live.close()


if __name__ == "__main__":
    main()
