"""What may come of a file: a sound clip that survives writing, or one short sentence that names it."""

from __future__ import annotations

import time
import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from poise.motion import Clip, describe

#: Longest sentence behind the file's name, and time that any file of up to 1 MB may take, s.
LONGEST, SECONDS = 300, 6.0


@dataclass(frozen=True)
class Verdict:
    """What came of a file: "read", "refused" or what is wrong; the sentence or the traceback."""

    kind: str
    text: str = ""

    @property
    def sound(self) -> bool:
        return self.kind in ("read", "refused")


def judge(
    folder: Path, name: str, files: dict[str, bytes], again: bool = False, seconds: float = SECONDS
) -> Verdict:
    """Reads a file within `seconds` of the processor.

    again: writes what was read and reads it once more.
    """
    for path in folder.iterdir():
        # What is written anew need not be removed.
        if path.name not in files and path.is_file():
            path.unlink()
    for other, data in files.items():
        (folder / other).write_bytes(data)
    busy = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            verdict = _outcome(folder, name, files, again)
    except Warning as warning:
        return Verdict("warning", _last(warning))
    except Exception as error:
        return Verdict("traceback", _last(error))
    took = time.process_time() - busy
    return Verdict("slow", f"{took:.1f} s") if took > seconds else verdict


def _outcome(folder: Path, name: str, files: dict[str, bytes], again: bool) -> Verdict:
    try:
        if name.endswith(".xml"):
            from poise.body import read_mjcf

            read_mjcf(folder / name)
            return Verdict("read")
        clip = read_clip(folder / name, allow_pickle=True)
        facts = describe(clip)
    except PoiseError as error:
        return _sentence(str(error), folder, files)
    if not (np.isfinite(clip.positions()).all() and facts["frames"] >= 2 and facts["height_m"] > 0):
        return Verdict("unsound", f"{facts['frames']} frames, {facts['height_m']} m")
    for note in clip.skeleton.source.notes:
        # Line breaks are in what Poise itself wrote; the command line makes the rest printable.
        if len(note) > 2000:
            return Verdict("note", note[:400])
    return _round_trip(clip, folder) if again else Verdict("read")


def _sentence(said: str, folder: Path, files: dict[str, bytes]) -> Verdict:
    named = next((f for f in files if said.startswith(str(folder / f))), None)
    if named is None:
        return Verdict("nameless", said[:400])
    said = said.removeprefix(str(folder / named))
    if not said.isprintable():
        return Verdict("unprintable", said[:400])
    return Verdict("long" if len(said) > LONGEST else "refused", said)


def _round_trip(clip: Clip, folder: Path) -> Verdict:
    """What was read, written as Poise's own npz, is the same to the last bit."""
    path = folder / "again.poise.npz"
    try:
        write_clip(clip, path)
        other = read_clip(path)
    except PoiseError as error:
        return Verdict("round trip", str(error)[:400])
    a, b = clip, other
    same = (
        a.skeleton.names == b.skeleton.names
        and a.skeleton.parents == b.skeleton.parents
        and a.fps == b.fps
        and np.array_equal(a.root_pos, b.root_pos)
        and np.allclose(a.rot, b.rot, atol=1e-12)
        and np.allclose(a.skeleton.offsets, b.skeleton.offsets, atol=1e-12)
    )
    return Verdict("read") if same else Verdict("round trip", "another clip")


def _last(error: BaseException) -> str:
    """The innermost line of the source, and the error."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "poise" in f.filename]
    at = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "?"
    return f"{at} {type(error).__name__}: {error}"[:400]
