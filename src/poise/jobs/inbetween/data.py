"""A folder of motion files as one bank of frames, read once and then taken from its cache."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from poise.errors import PoiseError
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.library.folder import library_of
from poise.kin.rate.reading import read_clip
from poise.learn.checkpoint import load_checkpoint, save_checkpoint
from poise.motion import Clip
from poise.motion.io.formats import READERS
from poise.motion.windows import LAFAN1_FACING, FrameBank, pack_frames, without_still_root


def library_bank(
    library: Path,
    cache: Path,
    fps: float = 30.0,
    tell: Callable[[str], None] = lambda _: None,
    onto: str | None = None,
    reading: LibraryConfig | None = None,
) -> tuple[FrameBank, tuple[str, ...]]:
    """All motion files under a folder (or one file) that share the most common skeleton.

    Files that cannot be read and clips of other skeletons are left out, each with a sentence in the
    notes. With `onto`, a motion file, or with `reading`, all clips are brought onto one skeleton, see
    `library_of`. The bank is written to `cache` and taken from there while the files stay as they are.

    Raises:
        PoiseError: no file could be used.
    """
    files = motion_files(library)
    how = None
    if onto is not None or reading is not None:
        # Nothing is simulated: feet are learned as they are.
        reading = replace(reading or LibraryConfig(), level=False)
        how = json.loads(json.dumps([onto, asdict(reading)]))
    key = [[str(f.relative_to(library.parent)), f.stat().st_size, f.stat().st_mtime_ns] for f in files]
    if cache.exists():
        tensors, meta = load_checkpoint(cache)
        if (meta.get("key"), meta.get("fps"), meta.get("how")) == (key, fps, how):
            return _bank(tensors, meta), tuple(meta["notes"])
    if how is None:
        common, notes = of_one_skeleton(*read_all(files, tell))
    else:
        made, report = library_of(library, onto, fps, config=reading, tell=tell)
        common, notes = list(made.clips), tuple(report.sentences())
    bank = pack_frames(common, fps, LAFAN1_FACING if _is_lafan1(common[0]) else None)
    tensors, meta = _packed(bank)
    save_checkpoint(cache, tensors, {**meta, "key": key, "notes": list(notes), "fps": fps, "how": how})
    return bank, notes


def motion_files(library: Path) -> list[Path]:
    """Files under a folder with a suffix that a reader knows, in order.

    Raises:
        PoiseError: there is no such folder, or nothing in it.
    """
    if library.is_file():
        return [library]
    suffixes = {s for reader in READERS for s in reader.suffixes} - {".asf", ".json", ".txt"}
    files = sorted(f for f in library.rglob("*") if f.suffix.lower() in suffixes and f.is_file())
    if not files:
        what = "there is no motion file in it" if library.is_dir() else "there is no such folder"
        raise PoiseError(what, library, "Give a folder with BVH or AMC files")
    return files


def read_all(files: list[Path], tell: Callable[[str], None]) -> tuple[list[Clip], tuple[str, ...]]:
    """The clips of all files that can be read, and a sentence for each of the others."""
    clips, notes = [], []
    for k, file in enumerate(files, 1):
        try:
            clips.append(read_clip(file))
        except PoiseError as problem:
            notes.append(f"Left out: {problem}")
        if k % 200 == 0:
            tell(f"{k} of {len(files)} files read")
    if not clips:
        raise PoiseError(f"none of the {len(files)} files could be read", hint=notes[0])
    return clips, tuple(notes)


def of_one_skeleton(clips: list[Clip], notes: tuple[str, ...]) -> tuple[list[Clip], tuple[str, ...]]:
    """The clips of the most common hierarchy, and a sentence about the others."""

    def kind(clip: Clip) -> tuple[Any, ...]:
        skeleton = without_still_root(clip).skeleton
        return skeleton.names, skeleton.parents

    kinds = [kind(clip) for clip in clips]
    best, count = Counter(kinds).most_common(1)[0]
    if count < len(clips):
        others = [clip.name for clip, k in zip(clips, kinds, strict=True) if k != best]
        notes = (*notes, f"Left out: {len(others)} clips of other skeletons, such as '{others[0]}'")
    return [clip for clip, k in zip(clips, kinds, strict=True) if k == best], notes


def _is_lafan1(clip: Clip) -> bool:
    names = clip.skeleton.names
    return len(names) == 22 and names[0] == "Hips" and "Spine2" in names and "LeftToe" in names


def _packed(bank: FrameBank) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    tensors = {k: getattr(bank, k) for k in ("root", "rot", "offsets", "first")}
    meta = {k: list(getattr(bank, k)) for k in ("names", "parents", "clips", "feet", "facing")}
    return tensors, {**meta, "bank_fps": bank.fps, "ends": [[j, list(tip)] for j, tip in bank.ends]}


def _bank(tensors: dict[str, torch.Tensor], meta: dict[str, Any]) -> FrameBank:
    x, y, z = meta["facing"]
    ends = tuple((j, (a, b, c)) for j, (a, b, c) in meta.get("ends", ()))
    return FrameBank(
        tuple(meta["names"]), tuple(meta["parents"]), meta["bank_fps"], tensors["root"], tensors["rot"],
        tensors["offsets"], tensors["first"], tuple(meta["clips"]), tuple(meta["feet"]), (x, y, z), ends,
    )  # fmt: skip
