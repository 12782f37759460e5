"""BVH files: the text, its hierarchy and its rows of numbers, with the line of every mistake."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from poise.errors import PoiseError
from poise.formats.text import (
    CUT_OFF,
    MAX_HEADER_WORDS,
    MAX_JOINTS,
    MAX_NAME,
    MAX_VALUE,
    NO_ANIMATION,
    REST_POSE,
    append_numbers,
    at_line,
    decode,
    first_bad,
    number,
    others_note,
    read_bytes,
    shown,
)

POSITIONS = ("Xposition", "Yposition", "Zposition")
ROTATIONS = ("Xrotation", "Yrotation", "Zrotation")
_CANONICAL = {name.lower(): name for name in POSITIONS + ROTATIONS}


@dataclass
class BvhJoint:
    """One joint of the hierarchy as written, file units."""

    name: str
    parent: int
    line: int
    offset: tuple[float, float, float] | None = None
    channels: tuple[str, ...] | None = None
    tips: list[tuple[float, float, float]] = field(default_factory=list)


@dataclass(frozen=True)
class BvhFile:
    """A parsed file: joints in file order and `values (T, C)`, degrees and file units."""

    joints: list[BvhJoint]
    values: np.ndarray
    frame_time: float
    notes: tuple[str, ...]


class _Tokens:
    """The header's words, each with its line."""

    def __init__(self, lines: list[bytes], path: Path):
        self.path, self.words, self.at = path, [], 0
        self.words: list[tuple[str, int]] = []
        self.motion_line: int | None = None
        for i, line in enumerate(lines):
            if len(self.words) > MAX_HEADER_WORDS:
                raise PoiseError(
                    f"no MOTION in the first {MAX_HEADER_WORDS} words", path, code="over-limit"
                )
            parts = decode(line, path, i + 1).replace("{", " { ").replace("}", " } ").split()
            if parts and parts[0].upper() == "MOTION":
                self.motion_line = i
                return
            self.words += [(part, i + 1) for part in parts]
            self.last = i + 1

    def done(self) -> bool:
        return self.at >= len(self.words)

    def place(self) -> str:
        line = self.words[min(self.at, len(self.words) - 1)][1] if self.words else 1
        return at_line(self.path, line)

    def next(self, wanted: str) -> str:
        if self.done():
            cut = "MOTION starts" if self.motion_line is not None else "the file ends"
            raise PoiseError(
                f"{cut} where {wanted} was expected", self.place(), CUT_OFF, code="file-cut-off"
            )
        word = self.words[self.at][0]
        self.at += 1
        return word

    def expect(self, word: str) -> None:
        got = self.next(f"'{word}'")
        if got.upper() != word.upper():
            self.at -= 1
            raise PoiseError(
                f"'{word}' was expected, got {shown(got)}", self.place(), code="keyword-expected"
            )

    def vector(self) -> tuple[float, float, float]:
        out = []
        for _ in range(3):
            word = self.next("a number")
            self.at -= 1
            out.append(number(word, self.place()))
            self.at += 1
        return out[0], out[1], out[2]

    def name(self) -> str:
        """All words of the line up to a brace, so that names may hold blanks."""
        line = self.words[self.at - 1][1]
        words: list[str] = []
        while not self.done() and self.words[self.at][1] == line and self.words[self.at][0] not in "{}":
            words.append(self.next("a joint name"))
        name = " ".join(words)
        if not name or not name.isprintable() or len(name) > MAX_NAME:
            what = "a joint has no name" if not name else f"{shown(name)} is no joint name"
            raise PoiseError(what, at_line(self.path, line), code="not-a-name")
        return name


def parse_bvh(path: Path, rest: bool = False) -> BvhFile:
    """Reads a BVH file's hierarchy and motion; every refusal names the line.

    rest: a file without a frame, or that ends before MOTION, is two frames of its rest pose.
    """
    lines = read_bytes(path).splitlines()
    tokens = _Tokens(lines, path)
    hierarchy = _Hierarchy(tokens)
    joints = hierarchy.read()
    if tokens.motion_line is None and rest:
        return _one_body(_rested(joints, sum(len(j.channels or ()) for j in joints)), hierarchy.roots)
    if tokens.motion_line is None:
        raise PoiseError("the file ends before MOTION", path, CUT_OFF, code="file-cut-off")
    return _one_body(_motion(lines, tokens.motion_line + 1, joints, path, rest), hierarchy.roots)


def _one_body(file: BvhFile, roots: list[int]) -> BvhFile:
    """The body with most joints where the file has several ROOTs; the others are named."""
    if len(roots) == 1:
        return file
    spans = list(pairwise((*roots, len(file.joints))))
    best = max(spans, key=lambda span: span[1] - span[0])
    widths = [len(j.channels or ()) for j in file.joints]
    first, last = (sum(widths[:k]) for k in best)
    joints = file.joints[best[0] : best[1]]
    for joint in joints:
        joint.parent = max(-1, joint.parent - best[0])
    others = [(file.joints[a].name, b - a) for a, b in spans if (a, b) != best]
    note = others_note(joints[0].name, len(joints), others)
    return BvhFile(joints, file.values[:, first:last], file.frame_time, (*file.notes, note))


class _Hierarchy:
    """Reads the joints. stack: the open braces, a joint's index each, or -1 for an End Site."""

    def __init__(self, tokens: _Tokens):
        self.tokens, self.place = tokens, ""
        self.joints: list[BvhJoint] = []
        self.known: dict[str, int] = {}
        self.roots = [0]
        self.stack: list[int] = []

    def read(self) -> list[BvhJoint]:
        tokens = self.tokens
        tokens.expect("HIERARCHY")
        while not tokens.done():
            self.place = tokens.place()
            word = tokens.next("a joint").upper()
            if word in ("ROOT", "JOINT"):
                self._open_joint(word)
            elif word == "END":
                tokens.next("'Site'")
                tokens.expect("{")
                self._need_joint("an End Site stands outside a joint")
                self.stack.append(-1)
            elif word == "}":
                if not self.stack:
                    raise PoiseError(
                        "a closing brace has no opening one", self.place, code="brace-unmatched"
                    )
                self.stack.pop()
            elif word == "OFFSET":
                self._offset(tokens.vector())
            elif word == "CHANNELS":
                self._need_joint("CHANNELS stand outside any joint")
                self._channels(self.joints[self.stack[-1]])
            else:
                raise PoiseError(
                    f"{shown(word)} is not a BVH keyword",
                    self.place,
                    "Known: ROOT, JOINT, End Site, OFFSET, CHANNELS, MOTION",
                    code="unknown-keyword",
                )
        self._check_closed()
        return self.joints

    def _need_joint(self, otherwise: str) -> None:
        if not self.stack or self.stack[-1] < 0:
            raise PoiseError(otherwise, self.place, code="line-misplaced")

    def _open_joint(self, word: str) -> None:
        line = self.tokens.words[self.tokens.at - 1][1]
        name = self.tokens.name()
        if word == "JOINT":
            self._need_joint(f"joint '{name}' stands outside any other joint")
        if word == "ROOT" and self.stack:
            raise PoiseError(f"ROOT '{name}' stands inside a joint", self.place, code="line-misplaced")
        if word == "ROOT" and self.joints:
            # A second body may have the names of the first.
            self.roots.append(len(self.joints))
            self.known.clear()
        if name in self.known:
            raise PoiseError(
                f"joint name '{name}' appears twice (first in line {self.known[name]})",
                self.place,
                "Rename one of them",
                code="name-repeated",
            )
        if len(self.joints) >= MAX_JOINTS:
            raise PoiseError(f"more than {MAX_JOINTS} joints", self.place, code="too-many-joints")
        self.tokens.expect("{")
        self.known[name] = line
        self.joints.append(BvhJoint(name, self.stack[-1] if self.stack else -1, line))
        self.stack.append(len(self.joints) - 1)

    def _offset(self, vector: tuple[float, float, float]) -> None:
        if not self.stack:
            raise PoiseError("an OFFSET stands outside any joint", self.place, code="line-misplaced")
        joint = self.joints[self.stack[-1] if self.stack[-1] >= 0 else self.stack[-2]]
        if self.stack[-1] < 0:
            joint.tips.append(vector)
        elif joint.offset is not None:
            raise PoiseError(f"joint '{joint.name}' has two OFFSETs", self.place, code="line-repeated")
        else:
            joint.offset = vector

    def _channels(self, joint: BvhJoint) -> None:
        count = self.tokens.next("the number of channels")
        if not (count.isdigit() and count.isascii()) or int(count) > 6:
            what = f"joint '{joint.name}' must have 0 to 6 channels, got {shown(count)}"
            raise PoiseError(what, self.place, code="channel-count")
        if joint.channels is not None:
            raise PoiseError(
                f"joint '{joint.name}' has two CHANNELS lines", self.place, code="line-repeated"
            )
        channels = []
        for _ in range(int(count)):
            word = self.tokens.next("a channel name")
            if word.lower() not in _CANONICAL:
                raise PoiseError(
                    f"{shown(word)} is not a channel of joint '{joint.name}'",
                    self.place,
                    f"Known: {', '.join(_CANONICAL.values())}",
                    code="unknown-channel",
                )
            channels.append(_CANONICAL[word.lower()])
        if len(set(channels)) != len(channels):
            raise PoiseError(
                f"joint '{joint.name}' names a channel twice", self.place, code="channel-repeated"
            )
        joint.channels = tuple(channels)

    def _check_closed(self) -> None:
        place = self.tokens.place()
        if not self.joints:
            raise PoiseError("the hierarchy has no ROOT", place, CUT_OFF, code="root-missing")
        if self.stack:
            name = next(self.joints[j].name for j in reversed(self.stack) if j >= 0)
            raise PoiseError(
                f"the brace of joint '{name}' is never closed", place, CUT_OFF, code="brace-unmatched"
            )
        for joint in self.joints:
            for what, value in (("OFFSET", joint.offset), ("CHANNELS", joint.channels)):
                if value is None:
                    where = at_line(self.tokens.path, joint.line)
                    raise PoiseError(f"joint '{joint.name}' has no {what}", where, code="part-missing")


def _motion(lines: list[bytes], start: int, joints: list[BvhJoint], path: Path, rest: bool) -> BvhFile:
    """The frames: count, time, and the rows with exactly one number per channel."""
    width = sum(len(j.channels or ()) for j in joints)
    rows = ((i + 1, line.split()) for i, line in enumerate(lines[start:], start) if line.strip())
    count_line, count_text = _entry(rows, b"Frames:", path, len(lines))
    if not count_text.isdigit():
        raise PoiseError(
            f"the number of frames is {shown(count_text)}, which is no whole number",
            at_line(path, count_line),
            code="not-a-number",
        )
    # More digits than this cannot be met by any file within the size limit.
    stated = int(count_text[:12])
    if not stated and rest:
        return _rested(joints, width)
    time_line, time_text = _entry(rows, b"Frame Time:", path, len(lines))
    frame_time = number(time_text, at_line(path, time_line))
    if frame_time <= 0:
        raise PoiseError(
            f"the frame time is {frame_time:g} s, which must be above 0",
            at_line(path, time_line),
            code="rate-out-of-range",
        )
    if not stated:
        raise PoiseError(
            "the file has no frame of motion", at_line(path, count_line), NO_ANIMATION, code="no-frames"
        )
    if width == 0:
        raise PoiseError("no joint has any channel, so nothing moves", path, code="no-channels")
    values: array[float] = array("d")
    numbers: list[int] = []
    extra = 0
    for line, tokens in rows:
        if len(numbers) == stated:
            extra += 1
            continue
        if len(tokens) != width:
            raise PoiseError(
                f"the row of frame {len(numbers)} has {len(tokens)} numbers; the channels need {width}",
                at_line(path, line),
                code="row-width",
            )
        append_numbers(values, tokens, at_line(path, line))
        numbers.append(line)
    if len(numbers) < stated:
        raise PoiseError(
            f"{stated} frames are stated, but only {len(numbers)} rows follow",
            at_line(path, count_line),
            CUT_OFF,
            code="frames-missing",
        )
    table = np.frombuffer(values).reshape(-1, width)
    if rest and stated == 1:
        table = np.repeat(table, 2, axis=0)
        numbers *= 2
    _check_values(table, joints, numbers, path)
    rows_more = f"{extra} row{'s' if extra > 1 else ''}"
    notes = (f"{rows_more} after the stated {stated} frames were left out",) if extra else ()
    return BvhFile(joints, table, frame_time, notes)


def _rested(joints: list[BvhJoint], width: int) -> BvhFile:
    """Two frames of the rest pose: position channels hold the OFFSETs."""
    values = np.zeros((2, width))
    column = 0
    for joint in joints:
        for channel in joint.channels or ():
            if channel in POSITIONS:
                values[:, column] = (joint.offset or (0.0, 0.0, 0.0))[POSITIONS.index(channel)]
            column += 1
    return BvhFile(joints, values, 1 / 30, (REST_POSE,))


def _entry(rows, key: bytes, path: Path, end: int) -> tuple[int, bytes]:  # type: ignore[no-untyped-def]
    """The line and value of "Frames: N" or "Frame Time: S"."""
    line, tokens = next(rows, (end, None))
    if tokens is None:
        raise PoiseError(f"the file ends before '{key.decode()}'", path, CUT_OFF, code="file-cut-off")
    text = b" ".join(tokens)
    if not text.lower().startswith(key.lower()):
        raise PoiseError(
            f"'{key.decode()}' was expected, got {shown(text)}",
            at_line(path, line),
            code="keyword-expected",
        )
    value = text[len(key) :].strip()
    if not value:
        raise PoiseError(f"'{key.decode()}' has no value", at_line(path, line), code="part-missing")
    return line, value


def _check_values(table: np.ndarray, joints: list[BvhJoint], lines: list[int], path: Path) -> None:
    bad = first_bad(table)
    if bad is None:
        return
    frame, column = bad
    owners = [(j.name, c) for j in joints for c in j.channels or ()]
    name, channel = owners[column]
    value = table[frame, column]
    what = f"larger than {MAX_VALUE:g}" if np.isfinite(value) else "not a finite number"
    raise PoiseError(
        f"{channel} of joint '{name}' at frame {frame} is {value:g}, {what}",
        at_line(path, lines[frame]),
        code="number-unusable",
    )
