"""Every motion file of the data set: is it read, is it recognised, how fast, and what is wrong with it.

    python benchmarks/read_all.py --data FOLDER [--only PART] [--out FILE.md] [--json FILE.json]

FOLDER holds `INDEX.tsv` (path, format, joints, fps, frames, ...) and the files that it lists. What the
index does not tell, the true unit and vertical of each folder, stands in `GROUPS`.
"""

from __future__ import annotations

import argparse
import csv
import fnmatch
import json
import platform
import re
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from poise.errors import PoiseError
from poise.formats import read_clip
from poise.kinematics import by_kind, examine
from poise.motion import describe

ASF = 0.0254 / 0.45
COMMAND = "python benchmarks/read_all.py --data FOLDER"
#: A unit counts as found within this share of the truth, a frame rate within this one.
UNIT_SLACK, RATE_SLACK = 0.05, 0.001


@dataclass(frozen=True)
class Group:
    """Files of one source. unit (m) and up: the truth, from their documentation or a twin in another
    format; None where the format itself states it. skip: why they are no human motion in 3-D. columns:
    the index counts markers or coordinates, not the joints that they are made into."""

    title: str
    pattern: str
    unit: float | None = None
    up: str | None = None
    skeleton: str | None = None
    skip: str = ""
    columns: bool = False


#: The first pattern that fits decides.
GROUPS = (
    Group("CMU, ASF and AMC, RFC's clips", "cmu_amc/rfc/*.amc", ASF, "Y", "cmu_amc/rfc/08.asf"),
    Group("CMU, ASF and AMC", "cmu_amc/*.amc", ASF, "Y"),
    Group("CMU as BVH, 43 joints", "cmu_bvh/acrnn_*", 0.01, "Y"),
    Group("CMU as BVH, 31 joints", "cmu_bvh/fairmotion/*", ASF, "Y"),
    Group("CMU as BVH, 31 joints", "cmu_bvh/ad/14_14.bvh", ASF, "Y"),
    Group("CMU as BVH, 31 joints", "cmu_bvh/ad/jumping_jacks.bvh", ASF, "Y"),
    # heiansyodan is 135_06: its path has the length of the AMC's if one unit is an inch.
    Group("CMU as BVH, V conversion", "cmu_bvh/ad/*", 0.0254, "Z"),
    Group("DeepMimic", "deepmimic_txt/*", 1.0, "Y"),
    Group("LAFAN1", "lafan1_bvh/*", 0.01, "Y"),
    Group("Bandai Namco", "other/bandai_bvh/*", 0.01, "Y"),
    Group("MASS", "other/mass_bvh/*", 0.01, "Y"),
    Group("Xsens", "other/xsens_bvh/*", 0.01, "Y"),
    Group("Rokoko, from a video", "noisy/rokoko_video/*", 0.01, "Y"),
    Group("Pose2Sim, 3-D keypoints", "noisy/pose2sim/*.trc", 1.0, "Y", columns=True),
    Group("Pose2Sim, 2-D keypoints", "noisy/pose2sim/*_json/", skip="one camera's 2-D picture"),
    Group("Pose2Sim, OpenSim angles", "noisy/pose2sim/*.mot", columns=True),
    Group("AIST++, SMPL", "amass/*.pkl"),
    Group("AMP and ASE, poselib", "other/ase_npy/*.npy"),
    # The index adds up the frames of its thirty motions, of which one is read.
    Group("MDM, generated", "other/text_to_motion/mdm*", 1.0, "Y", columns=True),
    Group("Kimodo", "other/text_to_motion/kimodo*", skip="a robot's joint angles"),
    Group("LocoMuJoCo", "other/loco_mujoco_npz/*", columns=True),
    Group("dm_control", "other/dm_control/*", skip="a simulated model's coordinates"),
    Group(
        "damaged on purpose",
        "other/malformed/*",
        skeleton="cmu_amc/usc/135-martialArts.asf",
        skip="a damaged file",
    ),
)


@dataclass
class Seen:
    """What became of one file; `wrong` lists what was not recognised."""

    path: str
    group: str
    megabytes: float
    seconds: float = 0.0
    refused: str = ""
    facts: dict[str, Any] = field(default_factory=dict)
    faults: dict[str, int] = field(default_factory=dict)
    worst: dict[str, str] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)


def group_of(path: str) -> Group:
    """The group of an index path."""
    return next(g for g in GROUPS if fnmatch.fnmatch(path, g.pattern))


def look(data: Path, row: dict[str, str]) -> Seen:
    """Reads one file and examines its motion; only the reading is timed."""
    group, file = group_of(row["path"]), data / row["path"]
    size = sum(f.stat().st_size for f in ([file] if file.is_file() else file.glob("*"))) / 1e6
    seen = Seen(row["path"], group.title, size)
    skeleton = None if group.skeleton is None else data / group.skeleton
    start = time.process_time()
    try:
        clip = read_clip(file, skeleton=skeleton, allow_pickle=True)
    except PoiseError as problem:
        seen.refused = str(problem).replace(f"{data}/", "")
        return seen
    finally:
        seen.seconds = time.process_time() - start
    facts = describe(clip)
    seen.facts = {k: v for k, v in facts.items() if k not in ("warnings", "height_from", "seconds")}
    seen.wrong = list(_wrong(row, group, facts))
    for kind, faults in by_kind(examine(clip).faults).items():
        worst = max(faults, key=lambda f: f.size)
        seen.faults[kind] = len(faults)
        seen.worst[kind] = f"{worst.joint or 'whole body'} {worst.start}-{worst.stop}: {worst.size:.3g}"
    return seen


def _wrong(row: dict[str, str], group: Group, facts: dict[str, Any]) -> list[str]:
    """What was recognised otherwise than the truth says."""
    out = []
    if group.unit is not None and abs(facts["unit_m"] / group.unit - 1) > UNIT_SLACK:
        out.append(f"unit {facts['unit_m']:.4g} m instead of {group.unit:.4g}")
    if group.up is not None and facts["up_axis"] != group.up:
        out.append(f"{facts['up_axis']} up instead of {group.up}")
    if row["fps"] and abs(facts["fps"] / float(row["fps"]) - 1) > RATE_SLACK:
        out.append(f"{facts['fps']:.4g} frames/s instead of {row['fps']}")
    if group.columns:
        return out
    if row["frames"] and facts["frames"] != int(row["frames"]) - _dropped(facts["warnings"]):
        out.append(f"{facts['frames']} frames instead of {row['frames']}")
    if row["joints"] and facts["joints"] != int(row["joints"]):
        out.append(f"{facts['joints']} joints instead of {row['joints']}")
    return out


def table(seen: list[Seen]) -> list[str]:
    """One row per group."""
    lines = [
        "| files | read | format | joints | unit, m | up | frames/s | height, m | otherwise | s/MB |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for title in dict.fromkeys(s.group for s in seen):
        mine = [s for s in seen if s.group == title]
        read = [s for s in mine if s.facts]
        cells = [title, f"{len(read)} of {len(mine)}"]
        if read:
            facts = [s.facts for s in read]
            heights = [f["height_m"] for f in facts]
            wrong = Counter(w for s in read for w in s.wrong)
            size = sum(s.megabytes for s in read)
            cells += [
                _values(f["format"] for f in facts),
                _values(f["joints"] for f in facts),
                _values(f"{f['unit_m']:.4g}" for f in facts),
                _values(f["up_axis"] for f in facts),
                _values(f"{f['fps']:.4g}" for f in facts),
                f"{min(heights):.2f} to {max(heights):.2f}",
                "; ".join(f"{w} ({n})" for w, n in wrong.items()) or "none",
                f"{sum(s.seconds for s in read) / size:.3f}",
            ]
        lines.append("| " + " | ".join(cells + [""] * (10 - len(cells))) + " |")
    return lines


def _values(values: Any) -> str:
    return ", ".join(dict.fromkeys(str(v) for v in values))


def faults(seen: list[Seen]) -> list[str]:
    """Per group: in how many files each kind of fault is, and where it is worst."""
    lines = ["| files | fault | in files | spells | worst |", "|---|---|---|---|---|"]
    for title in dict.fromkeys(s.group for s in seen):
        mine = [s for s in seen if s.group == title and s.facts]
        kinds = dict.fromkeys(k for s in mine for k in s.faults)
        for kind in kinds:
            having = [s for s in mine if kind in s.faults]
            worst = max(having, key=lambda s: float(s.worst[kind].rsplit(" ", 1)[1]))
            name = Path(worst.path).name
            spells = sum(s.faults[kind] for s in having)
            lines.append(
                f"| {title} | {kind} | {len(having)} of {len(mine)} | {spells} | `{name}` "
                f"{worst.worst[kind]} |"
            )
        clean = sum(not s.faults for s in mine)
        if mine:
            lines.append(f"| {title} | none at all | {clean} of {len(mine)} | | |")
    return lines


def _dropped(notes: Sequence[str]) -> int:
    """Frames of a rest pose that reading left out."""
    for note in notes:
        if note.startswith("Frame 0 is a rest pose"):
            more = re.search(r"these (\d+) frames", note)
            return int(more[1]) if more else 1
    return 0


def known(seen: list[Seen]) -> list[str]:
    """The faults that are known to be in the data, and what was said of them."""
    by_path = {s.path: s for s in seen}
    lines = ["| file | known fault | found |", "|---|---|---|"]
    for name, frames in (("04", "347 to 351"), ("10", "318 to 362")):
        found = by_path.get(f"cmu_bvh/acrnn_salsa/{name}.bvh")
        if found is not None:
            count, worst = found.faults.get("teleport", 0), found.worst.get("teleport", "-")
            said = f"{count} teleports, worst {worst} m (without the rest pose's frames)"
            lines.append(
                f"| `acrnn_salsa/{name}.bvh` | root teleports, frames {frames} of the file | {said} |"
            )
    off = [s for s in seen if "quaternion length" in s.faults]
    if off:
        joints = sum(s.faults["quaternion length"] for s in off)
        lines.append(
            f"| `deepmimic_txt` | quaternions off unit length | {joints} joints in {len(off)} files |"
        )
    lines += [
        f"| `{s.path}` | damaged on purpose | {s.refused} |" for s in seen if "malformed" in s.path
    ]
    return lines


def page(seen: list[Seen]) -> str:
    """The page `benchmarks/notes/reading.md`."""
    total = sum(s.seconds for s in seen)
    size = sum(s.megabytes for s in seen)
    read = [s for s in seen if s.facts]
    human = [s for s in seen if not group_of(s.path).skip]
    wrong = [s for s in read if s.wrong]
    left = [s for s in seen if s.refused and "malformed" not in s.path]
    parts = [
        "# Reading real files",
        f"```sh\n{COMMAND}\n```",
        f"Every file of a development set of {len(seen)} motion files, and what "
        "`poise info` and `poise doctor` say of it. Nothing was stated but the skeleton of the clips "
        "that come without their own; unit, vertical and rate are guessed, and compared with the truth.",
        f"{len(read)} of {len(human)} files with human motion are read, {len(wrong)} with something "
        f"recognised otherwise than it is. Reading all {size:.0f} MB takes {total:.1f} s on one thread "
        f"({total / max(size, 1e-9):.3f} s per MB).",
        "## What was recognised",
        "\n".join(table(seen)),
        "## Known faults",
        "\n".join(known(seen)),
        "## What the motion doctor finds",
        "Sizes are in the units of `poise doctor`: cm for floor and feet, degrees for flips and limits, "
        "rad/s for speeds, mm for jitter and bones, m for teleports. Frames count from 0 in the clip as "
        "read.",
        "\n".join(faults(seen)),
    ]
    if left:
        rows = [f"| `{s.path}` | {group_of(s.path).skip or '-'} | {s.refused} |" for s in left]
        parts += [
            "## What is not read",
            "\n".join(["| file | what it is | what Poise says |", "|---|---|---|", *rows]),
        ]
    return "\n\n".join(parts) + "\n"


def main() -> None:
    """Reads, writes the page and the numbers."""
    here = Path(__file__).resolve().parent
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--only", default="", help="only paths that hold this")
    parser.add_argument("--out", type=Path, default=here / "notes" / "reading.md")
    parser.add_argument("--json", type=Path, default=here / "read_all.json")
    options = parser.parse_args()
    torch.set_num_threads(1)
    with (options.data / "INDEX.tsv").open(newline="") as file:
        rows = [r for r in csv.DictReader(file, delimiter="\t") if options.only in r["path"]]
    # Skeletons alone are no motion; they are read with the motions that need them.
    rows = [r for r in rows if not r["path"].endswith(".asf")]
    # The first file pays for imports and caches that are no reading.
    look(options.data, rows[0])
    seen = []
    for row in rows:
        seen.append(look(options.data, row))
        print(f"{row['path']}: {seen[-1].refused or seen[-1].wrong or 'as stated'}", flush=True)
    options.out.write_text(page(seen), encoding="utf-8")
    total, size = sum(s.seconds for s in seen), sum(s.megabytes for s in seen)
    by_format: dict[str, dict[str, float]] = {}
    for s in seen:
        if s.facts:
            entry = by_format.setdefault(
                s.facts["format"], {"files": 0, "megabytes": 0.0, "seconds": 0.0}
            )
            entry["files"] += 1
            entry["megabytes"] += s.megabytes
            entry["seconds"] += s.seconds
    for entry in by_format.values():
        entry["seconds_per_megabyte"] = entry["seconds"] / entry["megabytes"]
    result = {
        "command": COMMAND,
        "machine": f"{platform.machine()}, {platform.python_version()}, one thread",
        "seconds": total,
        "megabytes": size,
        "seconds_per_megabyte": total / size,
        "by_format": by_format,
        "files": [asdict(s) for s in seen],
    }
    options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
