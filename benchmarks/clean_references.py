"""What cleaning changes in real clips: a table of before and after.

    python benchmarks/clean_references.py --data FOLDER [--only PART] [--out FILE.json]

FOLDER holds the clips as `cmu_amc/rfc/*.amc` (with `08.asf`), `cmu_amc/02/*.amc`, `deepmimic_txt/*.txt`
and some BVH. "Before" is the file on a body made from it, at its own height; "after" is `fit_humanoid`.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch

from poise.body import BodyTable, find_anatomy, generate_table
from poise.formats import read_clip
from poise.kinematics import Kinematics, clean_clip, clip_to_qpos, fit_humanoid, lowest_height
from poise.kinematics.forward import centre_of_mass
from poise.kinematics.rate import find_flights
from poise.kinematics.repair.turns import out_of_reach
from poise.motion import Clip, resample
from poise.motion.rotations import quat_angle, quat_conj, quat_mul

RATE = 30.0
BVH = (
    *("cmu_bvh/ad/back_handspring1_autolabel.bvh", "cmu_bvh/ad/jumping_jacks.bvh"),
    *("cmu_bvh/acrnn_salsa/04.bvh", "cmu_bvh/acrnn_martial/04.bvh", "cmu_bvh/acrnn_indian/04.bvh"),
    *("other/mass_bvh/backflip.bvh", "other/bandai_bvh/dataset-1_run_active_001.bvh"),
)


def find_clips(data: Path) -> list[Path]:
    """The clips that are measured, those of the RFC paper first."""
    found = [p for folder in ("rfc", "02") for p in sorted((data / "cmu_amc" / folder).glob("*.amc"))]
    found += sorted((data / "deepmimic_txt").glob("*.txt"))
    return found + [data / name for name in BVH if (data / name).exists()]


def speeds(clip: Clip) -> tuple[str, float]:
    """The fastest joint that carries a body, and its largest speed at the file's rate, rad/s."""
    joints = [p.joint for p in find_anatomy(clip.skeleton).parts]
    rot = torch.tensor(clip.rot[:, joints])
    top = quat_angle(quat_mul(quat_conj(rot[:-1]), rot[1:])).max(0).values * clip.fps
    return clip.skeleton.names[joints[int(top.argmax())]], float(top.max())


def flipped(clip: Clip) -> int:
    """Frames in which a foot or hand is where none reaches, summed over them."""
    return sum(frames for _, frames in out_of_reach(clip, find_anatomy(clip.skeleton)))


def beyond(qpos: np.ndarray, table: BodyTable) -> float:
    """The farthest that a hinge is outside its range, degrees."""
    ranges = np.array([r for row in table.rows for r in row.ranges])
    out = np.maximum(ranges[:, 0] - qpos[:, 7:], qpos[:, 7:] - ranges[:, 1])
    return float(np.degrees(max(out.max(), 0.0)))


def floor(qpos: np.ndarray, table: BodyTable) -> dict[str, float]:
    """Depth of soles and of all bodies, hovering where no flight is, root acceleration; mm and m/s^2."""
    state = Kinematics(table)(torch.tensor(qpos))
    lows = lowest_height(table, state.pos, state.quat).numpy()
    feet = [i for i, row in enumerate(table.rows) if row.kind == "foot"]
    low = lows.min(1)
    air = np.zeros(len(low), dtype=bool)
    com = centre_of_mass(table, state.pos, state.quat).numpy()
    for flight in find_flights(low, com, RATE):
        air[flight.start : flight.stop + 1] = True
    soles, bodies = np.maximum(-lows[:, feet].min(1), 0.0), np.maximum(-low, 0.0)
    hover = np.maximum(low[~air], 0.0) if not air.all() else np.zeros(1)
    acceleration = np.linalg.norm(np.diff(qpos[:, :3], 2, axis=0), axis=1) * RATE**2
    return {
        "sole_depth_max_mm": 1000 * float(soles.max()),
        "sole_depth_mean_mm": 1000 * float(soles.mean()),
        "body_depth_max_mm": 1000 * float(bodies.max()),
        "body_depth_mean_mm": 1000 * float(bodies.mean()),
        "hover_mean_mm": 1000 * float(hover.mean()),
        "hover_p90_mm": 1000 * float(np.quantile(hover, 0.9)),
        "root_acceleration_max": float(acceleration.max()),
    }


def measure(clip: Clip, qpos: np.ndarray, table: BodyTable) -> dict:
    """All figures of one state of a clip."""
    joint, speed = speeds(clip)
    return {
        "fastest": joint,
        "speed_max": speed,
        "flipped_frames": flipped(clip),
        **floor(qpos, table),
    }


def compare(clip: Clip) -> dict:
    """Before, after and the repairs of one clip."""
    raw = resample(clip, RATE)
    own = generate_table(raw.skeleton, None, [raw])
    before = measure(clip, clip_to_qpos(raw, own), own)
    humanoid, (qpos,), report = fit_humanoid(clip, None, RATE)
    cleaned, _ = clean_clip(clip)
    after = measure(cleaned, qpos, humanoid.table)
    before["beyond_range_deg"] = beyond(clip_to_qpos(raw, own), own)
    # The fit may leave the file's hinge order for a better one; it widens by 10 degrees more.
    after["beyond_range_deg"] = max([0.0, *(grown - 10.0 for _, grown in report.widened)])
    return {
        "before": _rounded(before),
        "after": _rounded(after),
        "turned_back": sum(f.stop - f.start + 1 for f in report.clips[0].clean.flips),
        "slowed": sum(s.stop - s.start + 1 for s in report.clips[0].clean.speeds),
        "fall": report.clips[0].rate.fall,
        "likely_fps": report.clips[0].rate.likely,
        "fps": clip.fps,
        "frames": clip.frames,
    }


def _rounded(row: dict) -> dict:
    return {k: round(v, 1) if isinstance(v, float) else v for k, v in row.items()}


def markdown(found: dict[str, dict]) -> str:
    """The table for people."""
    head = (
        "| clip | fastest joint, rad/s | flipped frames | past its range, deg | soles deep, mm (mean) "
        "| bodies deep, mm (mean) | hovers, mm (p90) | root, m/s^2 | falls, m/s^2 |"
    )
    lines = [head, "|---|---|---|---|---|---|---|---|---|"]
    for name, row in found.items():
        b, a = row["before"], row["after"]

        def pair(key: str, mean: str | None = None, b: dict = b, a: dict = a) -> str:
            texts = [f"{x[key]:.0f}" + (f" ({x[mean]:.0f})" if mean else "") for x in (b, a)]
            return " → ".join(texts)

        fall = "" if row["fall"] is None else f"{row['fall']:.1f}"
        if row["likely_fps"]:
            fall += f": {row['likely_fps']:g} fps, not {row['fps']:.4g}"
        lines.append(
            f"| {name} | {b['fastest']} {b['speed_max']:.0f} → {a['fastest']} {a['speed_max']:.0f} "
            f"| {pair('flipped_frames')} | {pair('beyond_range_deg')} "
            f"| {pair('sole_depth_max_mm', 'sole_depth_mean_mm')} "
            f"| {pair('body_depth_max_mm', 'body_depth_mean_mm')} "
            f"| {pair('hover_mean_mm', 'hover_p90_mm')} | {pair('root_acceleration_max')} | {fall} |"
        )
    return "\n".join(lines) + "\n"


INTRO = """# Clean references

Every clip before and after Poise's repairs, at 30 Hz. Made by

```sh
python benchmarks/clean_references.py --data FOLDER
```

- **fastest joint**: among those that carry a body, at the file's own rate. A human elbow does 40.
- **flipped**: frames in which a foot or a hand is where none reaches (a foot 120 degrees from standing).
- **past its range**: the farthest hinge outside the file's limits (90 degrees where it states none),
  before in the file's order of hinges, after in the one that was chosen. The body's ranges are widened
  by what is left, plus 10 degrees, so that every frame can be reached.
- **deep**: below the floor, deepest and mean over frames; up to 20 mm are left to the contact.
- **hovers**: height of the lowest point where the body does not fall freely, mean and 90th percentile.
- **falls**: downward acceleration in flight. Four times gravity is a clip played twice too fast,
  which is then measured at its likely rate too.

"""


def main() -> None:
    """Measures all clips and writes one JSON and one table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--only", default="", help="clips whose path holds this text")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    found = {}
    for path in find_clips(args.data):
        if args.only not in str(path):
            continue
        skeleton = path.parent / "08.asf" if path.parent.name == "rfc" else None
        name = f"{path.parent.name}/{path.stem}"
        clip = read_clip(path, skeleton=skeleton)
        found[name] = compare(clip)
        rate = found[name]["likely_fps"]
        if rate:
            found[f"{name} at {rate:g} fps"] = compare(clip.replaced(fps=rate))
        print(name, flush=True)
    command = "python benchmarks/clean_references.py --data FOLDER"
    args.out.write_text(json.dumps({"command": command, "clips": found}, indent=1) + "\n")
    args.out.with_suffix(".md").write_text(INTRO + markdown(found))


if __name__ == "__main__":
    main()
