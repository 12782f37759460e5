"""Dances with keyframes a second apart, filled by `poise inbetween`, beside the recordings.

    python benchmarks/inbetween_demo.py CLIP ... [--skeleton FILE.asf] [--every 1.0] [--model FILE]
        [--picture docs/inbetween.svg] [--from 1.0]

Writes `inbetween_demo.json`: how exactly keyframes are met, and how much feet slide in the recording, in
the filled clip, and between the same keyframes interpolated. Draws the first clip's filled poses over
the recorded.
"""

from __future__ import annotations

import argparse
import json
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from poise.formats import read_clip
from poise.jobs.inbetween.fill import shipped_model
from poise.learn.inbetween_model import load_model
from poise.metrics.plausibility import foot_slide
from poise.motion import Clip
from poise.motion.rotations import quat_conj, quat_mul, quat_to_rotvec
from poise.motion.windows import foot_joints
from poise.score.report.svg import PoseRow, pose_rows
from poise.synthesis.filler import EACH_GAP, Filling, Gap, interpolated
from poise.synthesis.inbetween import fill_keyframes


def slides(clip: Clip, low: np.ndarray, ground: float) -> dict[str, float]:
    """mm/s: of the joints of the feet while they are near the floor, and where the source's stand."""
    feet = torch.tensor(clip.positions()[:, list(foot_joints(clip.skeleton))])
    moved = torch.diff(feet[..., :2], dim=0).norm(dim=-1) * clip.fps * 1000
    stands = torch.tensor(low[1:] & low[:-1])
    return {
        "own_contacts_mm_per_s": float(foot_slide(feet, clip.fps, height=0.05, ground=ground)),
        "recorded_contacts_mm_per_s": float(moved[stands].mean()),
    }


def one(path: Path, args: argparse.Namespace, picture: Path | None) -> dict:
    """What came of one clip, and its picture."""
    clip = read_clip(path, skeleton=args.skeleton)
    step = round(args.every * clip.fps)
    keys = list(range(0, clip.frames, step))
    begun = time.perf_counter()
    filled = fill_keyframes(
        clip, keys, load_model(shipped_model(args.model)), Filling(adaptation=EACH_GAP)
    )
    seconds = time.perf_counter() - begun
    gaps = [Gap(a, b) for a, b in pairwise(keys)]
    made, plain = filled.clips[0], interpolated(clip, *clip.tensors(), gaps)
    apart = np.abs(made.positions()[keys] - clip.positions()[keys]).max() * 1000
    turn = quat_mul(torch.tensor(made.rot[keys]), quat_conj(torch.tensor(clip.rot[keys])))
    degrees = float(torch.rad2deg(quat_to_rotvec(turn).norm(dim=-1)).max())
    # Where the recorded feet stand: near their own lowest places and slow.
    feet = clip.positions()[:, list(foot_joints(clip.skeleton))]
    ground = np.quantile(feet[..., 2], 0.02, axis=0)
    speed = np.linalg.norm(np.diff(feet, axis=0, append=feet[-1:]), axis=-1) * clip.fps
    low = (feet[..., 2] < ground + 0.03) & (speed < 0.35)
    found = {
        "clip": path.name, "fps": clip.fps, "frames": clip.frames, "keyframes": len(keys),
        "seconds_between": args.every, "keyframe_mm": float(apart), "keyframe_degrees": degrees,
        "seconds": seconds, "warnings": list(filled.warnings),
        "slide": {n: slides(c, low, float(ground.min())) for n, c in
                  (("recorded", clip), ("filled", made), ("interpolated", plain))},
        "mean_joint_error_mm": {
            n: float(np.linalg.norm(c.positions() - clip.positions(), axis=-1).mean() * 1000)
            for n, c in (("filled", made), ("interpolated", plain))
        },
    }  # fmt: skip
    if picture is None:
        return found
    first = keys[min(len(keys) - 3, round(args.begin / args.every))]
    frames = [first + round(k * step / 6) for k in range(13)]
    ghost = clip.positions()
    rows = [PoseRow("interpolated, over the recording", plain.positions(), ghost),
            PoseRow("poise inbetween, over the recording", made.positions(), ghost)]  # fmt: skip
    pose_rows(f"{path.name}: keyframes {args.every:g} s apart", rows, clip.skeleton.parents, frames,
              clip.fps, keys, path=picture)  # fmt: skip
    return found


def main() -> None:
    """Fills, measures, draws."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="+", metavar="CLIP")
    parser.add_argument("--skeleton", type=Path)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--every", type=float, default=1.0, help="seconds between keyframes")
    parser.add_argument("--from", dest="begin", type=float, default=1.0, help="seconds, first shown")
    parser.add_argument("--picture", type=Path, default=Path("docs/inbetween.svg"))
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    found = [one(path, args, args.picture if k == 0 else None) for k, path in enumerate(args.clips)]
    args.out.write_text(json.dumps(found, indent=2) + "\n")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
