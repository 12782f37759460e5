"""Libraries of `endless_tables.py`: pasts with what followed them, and clips to learn from."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from tracker import SIXTY, TWINS

from poise.body import BodyConfig
from poise.jobs.endless.endless_training import reach_of
from poise.jobs.endless.model import Motions, spread
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.library.files import subject_of
from poise.jobs.library.folder import library_of
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.learn.checkpoint import load_checkpoint, save_checkpoint
from poise.learn.cvae import PackedFrames
from poise.synthesis.generator import features_of

#: Frames of a past and of its future, 1 s and 2 s.
PAST, FUTURE = 30, 60
#: The most windows of a class in a split.
WINDOWS = 8
#: Every so many clips of a class, the first one included, are for Mix, none of their frames is learned.
APART = 5


class Library(NamedTuple):
    """One of the data sets: its folders in DATA, whole subjects that Cross holds out, and what a clip's
    name says is done in it, the first that fits; "other" is what none fits."""

    folders: tuple[str, ...]
    cross: tuple[str, ...]
    classes: tuple[tuple[str, str], ...]


LIBRARIES = {
    "CMU": Library(
        ("cmu_amc", "cmu_bvh"), ("cmu 05", "cmu 08", "cmu 11", "cmu 14", "cmu 39"),
        (
            ("dance", r"05_|salsa|indian|dance"),
            ("martial arts", r"02_0[5-9]|135_|14_|martial|punch|kick|heian|11_"),
            ("walk and run", r"(06|07|08|35|38|39|43)_|02_0[1-3]|walk|run|jog"),
        ),
    ),
    "Bandai": Library(
        ("other/bandai_bvh",), (),
        (
            ("turning walk", r"_walk_(turn|left|right|back)"),
            ("walk", r"_walk_"),
            ("run", r"_(run|dash)_"),
        ),
    ),
}  # fmt: skip


class Clips(NamedTuple):
    """Clips on the body: coordinates `(F, 7 + n)` of each, names."""

    qpos: list[Tensor]
    names: list[str]


class Window(NamedTuple):
    """A past `(p, 7 + n)`, what followed `(f, 7 + n)`, the class, the clip, whether its subject is held
    out."""

    past: Tensor
    true: Tensor
    kind: str
    clip: str
    cross: bool


def kind_of(name: str, library: Library) -> str:
    """The class of a clip."""
    return next((k for k, pattern in library.classes if re.search(pattern, name)), "other")


def clips_of(name: str, data: Path, work: Path, tracker: Tracker) -> Clips:
    """All clips of a library on the tracker's body; kept in `work`."""
    file = work / f"clips-{name}.safetensors"
    if not file.exists():
        how = LibraryConfig(rates=SIXTY, leave_out=TWINS)
        folders = [data / f for f in LIBRARIES[name].folders]
        library, _ = library_of(folders, tracker.target, config=how, body=BodyConfig(), tell=print)
        tensors = {c.name: torch.tensor(place(c, tracker).qpos) for c in library}
        save_checkpoint(file, tensors, {"kind": "clips"})
    tensors, _ = load_checkpoint(file)
    names = sorted(tensors)
    return Clips([tensors[n].double() for n in names], names)


def windows_of(clips: Clips, library: Library) -> tuple[list[Window], list[int]]:
    """Windows of every class in both splits, evenly spread over all there are, and the clips that are
    left to learn from."""
    groups: dict[tuple[str, bool], list[int]] = {}
    for k, name in enumerate(clips.names):
        if len(clips.qpos[k]) >= PAST + FUTURE:
            cross = subject_of(name) in library.cross
            groups.setdefault((kind_of(name, library), cross), []).append(k)
    out, held = list[Window](), set[int]()
    for (kind, cross), rows in sorted(groups.items()):
        test = rows if cross else rows[::APART]
        held |= set(test)
        every = [(k, i) for k in test for i in range(0, len(clips.qpos[k]) - PAST - FUTURE + 1, PAST)]
        for pick in spread(len(every), WINDOWS).tolist():
            k, i = every[pick]
            q = clips.qpos[k]
            past, true = q[i : i + PAST], q[i + PAST : i + PAST + FUTURE]
            out.append(Window(past, true, kind, clips.names[k], cross))
    # Neither short clips of held-out subjects are learned, nor partners of dancers that are held out.
    partners = {p for k in held for p in partners_of(clips.names[k])}
    return out, [
        k for k, n in enumerate(clips.names)
        if k not in held and n not in partners and subject_of(n) not in library.cross
    ]  # fmt: skip


def partners_of(name: str) -> set[str]:
    """Names of the other dancer of a salsa, whose take has a number that is 15 more or less."""
    found = re.search(r"(.*acrnn_salsa-)(\d+)$", name)
    return {f"{found[1]}{int(found[2]) + k:02d}" for k in (-15, 15)} if found else set()


def motions_of(clips: Clips, rows: Sequence[int], tracker: Tracker) -> Motions:
    """Some of the clips as networks learn them."""
    rate, qpos = tracker.config.sim.control_hz, [clips.qpos[k] for k in rows]
    frames = torch.cat([features_of(q, rate).float() for q in qpos])
    first = torch.tensor(np.cumsum([0, *(len(q) for q in qpos)]))
    pasts = [q[i : i + PAST] for q in qpos for i in range(0, len(q) - PAST, PAST)]
    angles = torch.cat(qpos)[:, 7:]
    return Motions(
        PackedFrames(frames, first), torch.stack(pasts), torch.stack((angles.amin(0), angles.amax(0))),
        reach_of(frames, tracker.humanoid.table, rate), tuple(tracker.humanoid.hinges), rate,
        tuple(clips.names[k] for k in rows),
    )  # fmt: skip
