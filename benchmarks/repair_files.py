"""Motion from video and from text before and after the repair. A part of `repair.py`.

FOLDER/noisy holds keypoints that cameras triangulated and motion from a single one, FOLDER/other results
of a text-to-motion model, FOLDER/kimodo the examples of github.com/nv-tlabs/kimodo (kimodo-soma-rp),
which are left out where they are not there. Their truth is not known: all figures are those that
`poise doctor` states of a file, before as it is read raw, after as it is read and repaired.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from poise.errors import PoiseError
from poise.formats import read_clip
from poise.kinematics import examine, heal
from poise.kinematics.repair.faults import read_faults
from poise.kinematics.repair.motion_doctor import READ_ONLY
from poise.motion import Clip

FILES = (
    "noisy/pose2sim/*/*.trc",
    "noisy/rokoko_video/*.bvh",
    "kimodo/*.npz",
    "other/text_to_motion/*.npy",
)
#: Motions that are read of a file that holds many.
TAKES = 10
FIGURES = ("sole_slide_mm_per_s", "jerk_m_per_s3")


def figures(clip: Clip) -> dict[str, float]:
    """Slide, jerk, faults of all kinds, and mm of a tremble (0 without one); what reading mended is no
    fault of the clip."""
    found, mended = examine(clip), read_faults(clip)
    faults = [f for f in found.faults if f.kind not in READ_ONLY and f not in mended]
    told = {name: found.figures.get(name) for name in FIGURES}
    out = {name: float("nan") if value is None else float(value) for name, value in told.items()}
    out["faults"] = float(len(faults))
    out["tremble_mm"] = max((f.size for f in faults if f.kind == "tremble"), default=0.0)
    return out


def motions(data: Path, few: bool) -> Iterator[tuple[str, list[tuple[Clip, Clip]]]]:
    """A file's name and its motions, each as it is and as reading and repair leave it."""
    for path in (p for pattern in FILES for p in sorted(data.glob(pattern))):
        pairs: list[tuple[Clip, Clip]] = []
        for take in map(str, range(TAKES)) if path.suffix == ".npy" else (None,):
            try:
                before = read_clip(path, take=take, raw=True, allow_pickle=True)
                pairs.append((before, heal(read_clip(path, take=take, allow_pickle=True))))
            except PoiseError as problem:
                print(problem)
                break
            if few:
                break
        if pairs:
            yield path.stem, pairs


def file_rows(data: Path, few: bool = False) -> Iterator[tuple[str, str, list[float]]]:
    """The figures of every file, one value for each of its motions."""
    for name, pairs in motions(data, few):
        told: dict[str, list[float]] = {}
        for before, after in pairs:
            for when, clip in (("before", before), ("after", after)):
                for metric, value in figures(clip).items():
                    told.setdefault(f"{when}: {metric}", []).append(value)
            if before.frames == after.frames:
                off = np.linalg.norm(after.positions() - before.positions(), axis=-1)
                told.setdefault("moved_mm", []).append(1e3 * float(off.mean()))
        for metric, values in told.items():
            yield name, metric, values
