"""Every pair among nine skeletons of one kind each: how well a motion goes from one onto the other.

    python benchmarks/retarget.py --data FOLDER [--frames N] [--out FILE.json]

FOLDER holds the clips named in `CLIPS`. Onto itself a motion must not change; there and back again is
measured against where it began. Times are processor seconds of one thread.
"""

from __future__ import annotations

import argparse
import json
import time
from itertools import product
from pathlib import Path

import numpy as np
import torch

from poise.formats import read_clip
from poise.kinematics import RetargetReport, retarget
from poise.motion import Clip, trim
from poise.motion.rotations import quat_distance

CLIPS = {
    "Bandai walk": "other/bandai_bvh/dataset-2_walk_active_005.bvh",
    "LAFAN1 walk": "lafan1_bvh/walk4_subject1.bvh",
    "CMU ASF walk": "cmu_amc/02/02_01.amc",
    "CMU Poser salsa": "cmu_bvh/acrnn_salsa/01.bvh",
    "DeepMimic walk": "deepmimic_txt/humanoid3d_walk.txt",
    "MASS walk": "other/mass_bvh/walk.bvh",
    "Xsens boxing": "other/xsens_bvh/251021_04_boxing_120Hz_cm_3DsMax.bvh",
    "Rokoko dance": "noisy/rokoko_video/jesse_dance.bvh",
    "CMU 3ds Max jacks": "cmu_bvh/ad/jumping_jacks.bvh",
}


def difference(a: Clip, b: Clip, joints: list[int]) -> dict[str, float]:
    """Distances (mm) and angles between local rotations (degrees) of some joints of two clips."""
    apart = np.linalg.norm(a.positions() - b.positions(), axis=-1)[:, joints] * 1000
    angle = torch.rad2deg(quat_distance(torch.tensor(a.rot), torch.tensor(b.rot)))[:, joints]
    return {
        "mean_mm": float(apart.mean()),
        "max_mm": float(apart.max()),
        "mean_deg": float(angle.mean()),
        "max_deg": float(angle.max()),
    }


def moved(report: RetargetReport) -> list[int]:
    """The target's joints that something moves."""
    return [row.target for row in report.joints.rows if row.source]


def compare(source: Clip, target: Clip) -> dict:
    """The figures of one pair."""
    began = time.process_time()
    made, report = retarget(source, target)
    seconds = time.process_time() - began
    back, again = retarget(made, source, example=target)
    return {
        "scale": report.scale,
        "direction_deg": report.direction_deg,
        "direction_max_deg": report.direction_max_deg,
        "trunk_deg": report.trunk_deg,
        "end_percent": report.end_percent,
        "contact_s": report.contact_s,
        "slide_mm_s": report.slide_mm_s,
        "depth_mm": report.depth_mm,
        "depth_max_mm": report.depth_max_mm,
        "frames": source.frames,
        "seconds": seconds,
        "there_and_back": difference(source, back, moved(again)),
    }


def _pair(values: tuple[float, float]) -> str:
    return f"{values[0]:.0f} → {values[1]:.0f}"


def markdown(found: dict[str, dict], same: dict[str, dict]) -> str:
    """The tables for people."""
    lines = [
        "| from | onto | scale | bones, deg (max) | trunk, deg | ends, % | contact, s | slide, mm/s "
        "| deepest, mm | back, mm (max) | back, deg | ms per frame |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in found.values():
        back = row["there_and_back"]
        lines.append(
            f"| {row['from']} | {row['onto']} | {row['scale']:.2f} "
            f"| {row['direction_deg']:.1f} ({row['direction_max_deg']:.0f}) | {row['trunk_deg']:.1f} "
            f"| {row['end_percent']:.0f} | {row['contact_s']:.1f} | {_pair(row['slide_mm_s'])} "
            f"| {_pair(row['depth_max_mm'])} | {back['mean_mm']:.1f} ({back['max_mm']:.0f}) "
            f"| {back['mean_deg']:.1f} | {1000 * row['seconds'] / row['frames']:.1f} |"
        )
    rows = list(found.values())
    mean = {
        key: np.mean([r[key] for r in rows])
        for key in ("direction_deg", "trunk_deg", "end_percent", "contact_s")
    }
    slide = [np.mean([r["slide_mm_s"][k] for r in rows]) for k in (0, 1)]
    depth = [np.mean([r["depth_max_mm"][k] for r in rows]) for k in (0, 1)]
    back = [np.mean([r["there_and_back"][k] for r in rows]) for k in ("mean_mm", "max_mm", "mean_deg")]
    most = max(r["direction_max_deg"] for r in rows)
    speed = np.mean([1000 * r["seconds"] / r["frames"] for r in rows])
    lines.append(
        f"| **mean of {len(rows)}** | | | {mean['direction_deg']:.1f} ({most:.0f}) "
        f"| {mean['trunk_deg']:.1f} | {mean['end_percent']:.0f} | {mean['contact_s']:.1f} "
        f"| {slide[0]:.0f} → {slide[1]:.0f} | {depth[0]:.0f} → {depth[1]:.0f} "
        f"| {back[0]:.1f} ({back[1]:.0f}) | {back[2]:.1f} | {speed:.1f} |"
    )
    lines += [
        "",
        "## Onto itself",
        "",
        "| clip | farthest joint, mm | largest turn, deg |",
        "|---|---|---|",
    ]
    lines += [f"| {n} | {r['max_mm']:.1e} | {r['max_deg']:.1e} |" for n, r in same.items()]
    return "\n".join(lines) + "\n"


INTRO = """# Retargeting

Every pair among nine skeletons, up to {frames} frames of each clip. Made by

```sh
python benchmarks/retarget.py --data FOLDER
```

- **bones**: angle between the directions of upper arms, forearms, thighs and shins in source and target,
  mean over frames and bones, and the largest. Only contacts bend limbs away; without them it is zero.
- **trunk**: angle of the line from hips to shoulders, against its angle while standing.
- **ends**: distance of hands, feet and head from where the source has them, seen from the hips, in
  percent of the hips' height. Arms and trunks of other proportions cause it, since directions are kept.
- **slide**: mean horizontal speed of feet in contact, source (at the target's size) → target.
- **deepest**: the deepest joint or bone tip under the floor, source (at the target's size) → target.
- **back**: the result moved back onto the first skeleton, against the clip where it began: mean
  (largest) distance of joints and mean angle of local rotations. What the other skeleton lacks is lost
  (the head's turn against the neck in DeepMimic's, which has one joint for both).

"""


def main() -> None:
    """Measures all pairs and writes one JSON and one table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    clips = {name: trim(read_clip(args.data / path), 0, args.frames) for name, path in CLIPS.items()}
    found, same = {}, {}
    for a, b in product(clips, clips):
        if a == b:
            made, _ = retarget(clips[a], clips[a])
            same[a] = difference(made, clips[a], list(range(len(made.skeleton))))
        else:
            found[f"{a} -> {b}"] = {"from": a, "onto": b, **compare(clips[a], clips[b])}
        print(a, "->", b, flush=True)
    command = "python benchmarks/retarget.py --data FOLDER"
    text = json.dumps({"command": command, "pairs": found, "onto_itself": same}, indent=1)
    args.out.write_text(text + "\n")
    args.out.with_suffix(".md").write_text(INTRO.format(frames=args.frames) + markdown(found, same))


if __name__ == "__main__":
    main()
