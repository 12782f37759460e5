"""Makes the embedded walk from a run of this project: its simulated motion on 22 plain joints.

    python training/demo_clip.py RUN [--out src/poise/data/walk.bvh]

RUN is the `run` folder of an imitated CMU walk. The joints that have no body are dropped, names are
the usual ones, 30 frames a second, centimetres, Y up.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from poise.formats import write_clip
from poise.jobs.deliver import simulated_clip
from poise.jobs.open import open_run
from poise.jobs.runs import evaluate, trained_policy
from poise.motion import Clip, Skeleton, resample
from poise.motion.rotations import quat_conj, quat_mul, quat_rotate_inv

NAMES = {
    "root": "Hips",
    "lowerback": "Spine",
    "upperback": "Spine1",
    "thorax": "Spine2",
    "lowerneck": "Neck",
    "head": "Head",
    **{f"{s}clavicle": f"{side}Shoulder" for s, side in (("l", "Left"), ("r", "Right"))},
    **{f"{s}humerus": f"{side}Arm" for s, side in (("l", "Left"), ("r", "Right"))},
    **{f"{s}radius": f"{side}ForeArm" for s, side in (("l", "Left"), ("r", "Right"))},
    **{f"{s}wrist": f"{side}Hand" for s, side in (("l", "Left"), ("r", "Right"))},
    **{f"{s}femur": f"{side}UpLeg" for s, side in (("l", "Left"), ("r", "Right"))},
    **{f"{s}tibia": f"{side}Leg" for s, side in (("l", "Left"), ("r", "Right"))},
    **{f"{s}foot": f"{side}Foot" for s, side in (("l", "Left"), ("r", "Right"))},
    **{f"{s}toes": f"{side}Toe" for s, side in (("l", "Left"), ("r", "Right"))},
}


def plain(clip: Clip) -> Clip:
    """The clip on the joints of `NAMES` alone; the kept joints stay where they were."""
    old = clip.skeleton
    keep = [j for j, name in enumerate(old.names) if name in NAMES]
    rest, (pos, quat) = old.rest_positions(), clip.world()
    parents, offsets, rot = [], [], []
    world = torch.tensor(quat)
    for j in keep:
        above = old.parents[j]
        while above >= 0 and above not in keep:
            above = old.parents[above]
        parents.append(keep.index(above) if above >= 0 else -1)
        if above < 0:
            offsets.append(np.zeros(3))
            rot.append(world[:, j])
            continue
        # Helper joints between the two do not move, so the first frame's offset holds for all.
        arm = quat_rotate_inv(world[0, above], torch.tensor(pos[0, j] - pos[0, above]))
        offsets.append(arm.numpy())
        rot.append(quat_mul(quat_conj(world[:, above]), world[:, j]))
    ends = tuple((keep.index(j), v) for j, v in old.ends if j in keep)
    tips = [("lwrist", "lhand"), ("rwrist", "rhand")]
    for wrist, hand in tips:
        tip = rest[old.index(hand)] - rest[old.index(wrist)]
        ends += ((keep.index(old.index(wrist)), tuple(float(x) for x in tip * 2)),)
    skeleton = Skeleton(
        tuple(NAMES[old.names[j]] for j in keep), tuple(parents), np.array(offsets), ends
    )
    return Clip(skeleton, clip.root_pos, torch.stack(rot, 1).numpy(), clip.fps, "walk")


def shorten(path: Path) -> None:
    """Two decimals are enough for a demo: 0.01 degrees and 0.1 mm."""
    lines = path.read_text().splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    rows = [" ".join(f"{float(x):.2f}" for x in line.split()) for line in lines[at:] if line.strip()]
    path.write_text("\n".join([*lines[:at], *rows]) + "\n")


def main() -> None:
    """Reads a run, writes the clip."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, default=Path("src/poise/data/walk.bvh"))
    args = parser.parse_args()
    imitation = open_run(args.run).task
    policy, meta = trained_policy(args.run, imitation)
    evaluation = evaluate(imitation, policy, meta)
    motion = resample(simulated_clip(imitation, evaluation), 30.0)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_clip(plain(motion), args.out)
    shorten(args.out)
    print(f"{args.out}: {args.out.stat().st_size / 1024:.0f} KiB, succ {evaluation.card.succ:.2f}")


if __name__ == "__main__":
    main()
