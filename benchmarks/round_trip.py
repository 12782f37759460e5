"""A captured walk, a salsa of 43 joints and a DeepMimic clip through `poise imitate` and back.

    python benchmarks/round_trip.py --data FOLDER [--minutes 5 25 4] [--work DIR]

Foot slide and penetration of the input, of the simulation and of the written motion, with the
character's own soles. Runs are kept in `--work` and go on where they stopped. Writes round_trip.json and
round_trip.md.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from poise.formats import read_clip

CLIPS = {
    "walk": "other/bandai_bvh/dataset-1_walk_normal_001.bvh",
    "salsa": "cmu_bvh/acrnn_salsa/12.bvh",
    "punch": "deepmimic_txt/humanoid3d_punch.txt",
}
STAGES = ("source", "simulated", "delivered")
FIGURES = {"point_slide_mm_per_s": 0, "penetration_mm": 1}


def one(clip: Path, out: Path, minutes: float, threads: int) -> dict:
    """One `poise imitate`, and whether the motion came back on the same joints."""
    command = [
        "imitate",
        str(clip),
        "-o",
        str(out),
        "--minutes",
        f"{minutes:g}",
        "--threads",
        str(threads),
    ]
    if (out.with_suffix("") / "run").exists():
        command.append("--resume")
    subprocess.run([sys.executable, "-m", "poise", *command], check=True)
    score = json.loads((out.with_suffix("") / "score.json").read_text())
    before, after = read_clip(clip), read_clip(out)
    names = [{n.replace(" ", "_") for n in c.skeleton.names} for c in (before, after)]
    return {
        "clip": clip.name,
        "minutes": minutes,
        "joints": len(names[0]),
        "same_joints": names[0] == names[1],
        "same_frames": before.frames == after.frames,
        "succ": score["succ"],
        "mpjpe_mm": score["mpjpe_mm"],
        "help_n": score["help"]["force_mean_n"],
        **{k: v for k, v in score["delivered"][0].items() if k != "clip"},
    }


def table(rows: dict[str, dict]) -> str:
    """Markdown: input, simulation, written motion."""
    lines = [
        "| clip | Succ | help, N | slide, mm/s: input, simulated, written | sinks, mm | ankles led |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in rows.items():
        slide, depth = (
            ", ".join(f"{row[stage][figure]:.{digits}f}" for stage in STAGES)
            for figure, digits in FIGURES.items()
        )
        moved = f"{row['held_mean_mm']:.0f} mean, {row['held_max_mm']:.0f} mm at most"
        lines.append(
            f"| {name} | {row['succ']:.3f} | {row['help_n']:.0f} | {slide} | {depth} | {moved} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Runs what has not been run, writes what is there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--minutes", type=float, nargs=3, default=(5.0, 25.0, 4.0))
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--work", type=Path, default=Path("runs/round_trip"))
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    rows = {
        name: one(args.data / path, args.work / f"{name}.bvh", minutes, args.threads)
        for (name, path), minutes in zip(CLIPS.items(), args.minutes, strict=True)
    }
    command = "python benchmarks/round_trip.py --data FOLDER"
    out = Path(__file__).with_suffix(".json")
    out.write_text(json.dumps({"command": command, "clips": rows}, indent=1) + "\n")
    out.with_suffix(".md").write_text(f"`{command}`\n\n{table(rows)}")


if __name__ == "__main__":
    main()
