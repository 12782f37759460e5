"""The files of a library, the names of its clips, and the key of their content."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from poise.errors import PoiseError
from poise.formats.arrays import is_statistics
from poise.formats.refused import refuse_flat_folder
from poise.formats.table import READERS
from poise.formats.text import read_head

#: Files that hold part of a motion beside them: its skeleton, its numbers.
COMPANIONS = (".asf", ".bin")
#: Ends of the names of clips that are a recording's image, the later one first.
BACKWARDS, MIRRORED = "-backwards", "-mirrored"
#: Suffixes that other files than motions have too, so that their content must tell.
_COMMON = (".txt", ".json", ".csv", ".npz")
_CMU_TAKE = re.compile(r"-(\d{1,3})_\d{1,3}(?!\d)")
_SUBJECT = re.compile(r"subject[ _-]?(\d+)", re.IGNORECASE)


@dataclass(frozen=True)
class MotionFile:
    """One file of a library.

    Attributes:
        path: where it lies.
        name: its folders from the library's own on and its stem, joined by "-" (a "-" in the stem
            becomes "_"), and unique.
        subject: the performer, see `subject_of`.
    """

    path: Path
    name: str
    subject: str


def motion_files_of(sources: Path | str | Sequence[Path | str]) -> list[MotionFile]:
    """Every motion file of folders and files, in order of its name.

    Formats that are read only when they are asked for (`.pkl`, robots) count only where the file
    itself is given.

    Raises:
        PoiseError: there is no such file or folder, or no motion in any of them.
    """
    given = [sources] if isinstance(sources, str | Path) else list(sources)
    found: dict[Path, tuple[str, ...]] = {}
    for source in map(Path, given):
        if not source.exists():
            raise PoiseError(
                "there is no such file or folder",
                source,
                "Give a folder of motion files",
                code="file-missing",
            )
        root = source.absolute()
        files = [root] if root.is_file() else sorted(f for f in root.rglob("*") if is_motion(f))
        base = root.parents[min(2, len(root.parents) - 1)] if root.is_file() else root.parent
        for file in files:
            *folders, stem = file.relative_to(base).with_suffix("").parts
            found.setdefault(file, (*folders, stem.replace("-", "_")))
    if not found:
        refuse_without_motion(given)
    out, seen = [], {}
    for path, parts in sorted(found.items(), key=lambda item: (item[1], str(item[0]))):
        name = "-".join(parts)
        seen[name] = seen.get(name, 0) + 1
        unique = name if seen[name] == 1 else f"{name}-{seen[name]}"
        out.append(MotionFile(path, unique, subject_of(unique)))
    return out


def same_library(was: Sequence[str], now: Sequence[str], clips: Iterable[str]) -> bool:
    """True if a run's library is the one that is stated now, also where it was moved since.

    A folder or file that is no longer where it was is known again: a folder by the files that the run's
    clips are from, wherever it is now and however it is called; another file, "onto FILE", by its name.

    Args:
        was, now: the folder or file, then words that tell how it is read.
        clips: names of the run's clips.
    """
    if [*was] == [*now]:
        return True
    if not was or len(was) != len(now):
        return False
    onto = "onto "
    for old, new in zip(was[1:], now[1:], strict=True):
        here, there = Path(new.removeprefix(onto)), Path(old.removeprefix(onto))
        both = old.startswith(onto) and new.startswith(onto)
        if old != new and not (both and here.name == there.name and not there.exists()):
            return False
    old, new = Path(was[0]), Path(now[0])
    if old == new or old.exists() or not new.exists():
        return old == new
    if new.is_file():
        return old.name == new.name
    files = {file.name.removeprefix(f"{new.name}-") for file in motion_files_of(new)}
    known = (c.removesuffix(BACKWARDS).removesuffix(MIRRORED) for c in clips)
    return all(name.removeprefix(f"{old.name}-") in files for name in known)


def refuse_without_motion(given: Sequence[Path | str]) -> NoReturn:
    """Refuses folders without any motion file, and says which files are."""
    for folder in map(Path, given):
        if folder.is_dir():
            refuse_flat_folder(folder)
    where = ", ".join(map(str, given)) or None
    hint = "Give a folder with motion files (BVH, AMC, GLB, C3D, TRC, npz and more: docs/formats.md)"
    raise PoiseError("holds no motion file", where, hint, code="no-motion-files")


def is_motion(path: Path) -> bool:
    """Whether a file found in a folder is a motion; what many files could be is told by its content."""
    suffix = path.suffix.lower()
    known = [r for r in READERS if suffix in r.suffixes and r.name != "ASF"]
    readers = [r for r in known if suffix not in r.asks]
    if not readers or not path.is_file():
        return False
    if suffix == ".npy":
        return not is_statistics(path)
    if suffix not in _COMMON:
        return True
    head = read_head(path).removeprefix(b"\xef\xbb\xbf").lstrip()
    return any(r.looks_like(head) for r in readers)


def subject_of(name: str) -> str:
    """The performer of the clip of this name.

    "cmu 02" for a take such as `02_01` below a folder with "cmu" in its name, "subject 1" where the
    name says so, else the folders before the last "-".
    """
    name = name.removesuffix(BACKWARDS).removesuffix(MIRRORED)
    take = _CMU_TAKE.search(name)
    if take and "cmu" in name[: take.start()].lower():
        return f"cmu {int(take[1]):02d}"
    folders, _, stem = name.rpartition("-")
    said = _SUBJECT.search(stem)
    return f"{folders} subject {said[1]}".strip() if said else folders or stem


def matches(patterns: Sequence[str], name: str, subject: str = "") -> bool:
    """Whether a pattern is found in a clip's name, or is its whole subject; case does not matter."""
    return any(
        re.search(p, name, re.IGNORECASE) or re.fullmatch(p, subject, re.IGNORECASE) for p in patterns
    )


def check_patterns(patterns: Sequence[str]) -> None:
    """Raises a PoiseError for what is no regular expression."""
    for pattern in patterns:
        try:
            re.compile(pattern)
        except re.error as problem:
            raise PoiseError(
                f"'{pattern}' is no regular expression: {problem}", code="bad-regex"
            ) from None


def content_key(files: Sequence[MotionFile], settings: Any) -> str:
    """A hash of the content of all files, of what lies beside them, of their names and of `settings`."""
    digest = hashlib.blake2b(digest_size=16)
    digest.update(json.dumps(settings, sort_keys=True, default=str).encode())
    beside = {f for folder in {m.path.parent for m in files} for f in folder.iterdir()}
    companions = sorted(f for f in beside if f.suffix.lower() in COMPANIONS and f.is_file())
    for name, path in [*((m.name, m.path) for m in files), *((f.name, f) for f in companions)]:
        data = path.read_bytes()
        digest.update(f"{name} {len(data)} ".encode() + data)
    return digest.hexdigest()
