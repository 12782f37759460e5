"""The buttons of the page: the verb that each runs, its settings, and the words that come of them."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

from poise.errors import PoiseError

Kind = Literal[
    "number", "choice", "flag", "take", "frames", "spans", "touches", "vector", "boxes", "maps"
]
LIMBS = ("left_hand", "right_hand", "left_foot", "right_foot")
TOUCHED = (*LIMBS, "pelvis")
MOST_ITEMS = 500
_JOINT = re.compile(r"[\w:.| -]{1,80}", re.ASCII)


@dataclass(frozen=True)
class Field:
    """A setting of a button.

    Attributes:
        name: as the page sends it; `flag` is the option of the command line, by default the same.
        label: for people; text: a sentence on it.
        kind: number; choice; flag; take: a motion of the project; frames: numbers of frames; spans:
            limbs with two frames; touches: limbs with a frame and a point; vector; boxes: what a motion
            rests on; maps: pairs of joints.
        default: the command line says nothing where the value is this. low, high, step: of a number.
        whole: a number without a fraction. advanced: shown in a fold.
        negative: the flag is said where the value is off. always: said also where it is the default,
            since that of the command line is another one.
    """

    name: str
    label: str
    kind: Kind
    default: Any = None
    text: str = ""
    low: float = -math.inf
    high: float = math.inf
    step: float = 1.0
    unit: str = ""
    choices: tuple[tuple[str, str], ...] = ()
    whole: bool = False
    advanced: bool = False
    flag: str = ""
    negative: bool = False
    always: bool = False


@dataclass(frozen=True)
class Action:
    """A button.

    Attributes:
        name: as the page sends it. label, text: for people.
        verb: the command. words: words of the command line that are always there.
        makes: the name of what it makes, after that of its motion.
        folder: whether the result is a folder with the simulation, a report and a score.
        needs: whether the motion must be one that a body did.
    """

    name: str
    label: str
    text: str
    verb: str
    makes: str
    fields: tuple[Field, ...]
    words: tuple[str, ...] = ()
    folder: bool = False
    needs: bool = False


def _buttons() -> dict[str, Action]:
    """The buttons that `actions.toml` lists."""
    held = tomllib.loads(
        files("poise").joinpath("live", "open", "assets", "actions.toml").read_text("utf-8")
    )
    shared = held["shared"]

    def field(row: Any) -> Field:
        told = shared[row] if isinstance(row, str) else row
        choices = tuple((str(value), str(text)) for value, text in told.get("choices", ()))
        return Field(**{**told, "choices": choices})

    out: dict[str, Action] = {}
    for name, row in held["actions"].items():
        more = {"fields": tuple(map(field, row["fields"])), "words": tuple(row.get("words", ()))}
        out[name] = Action(**{**row, **more, "name": name})
    return out


ACTIONS = _buttons()
#: Formats of an export, by suffix.
EXPORTS = {
    ".bvh": "BVH",
    ".fbx": "FBX",
    ".glb": "GLB",
    ".usda": "USD",
    ".npz": "npz (AMASS or Poise)",
    ".csv": "CSV",
}
#: Statements on a file, by the name of its option.
READING: dict[str, tuple[str, ...] | None] = {
    "up": ("Y", "Z", "X", "-Y", "-Z", "-X"),
    "unit": None,
    "fps": None,
    "ground": None,
    "take": None,
    "swap_sides": None,
    "raw": None,
    "allow_pickle": None,
}


def told() -> list[dict[str, Any]]:
    """The buttons for the page."""

    def row(value: Any) -> Any:
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return [
        {
            "name": a.name,
            "label": a.label,
            "text": a.text,
            "verb": a.verb,
            "words": a.words,
            "needs": a.needs,
            "fields": [{k: row(v) for k, v in asdict(f).items()} for f in a.fields],
        }
        for a in ACTIONS.values()
    ]


def reading_of(given: Any) -> dict[str, Any]:
    """Statements on a file, checked.

    Raises:
        PoiseError: it is none of `READING`, or makes no sense.
    """
    if not isinstance(given, Mapping) or any(k not in READING for k in given):
        raise _wrong("reading")
    out: dict[str, Any] = {}
    for name, value in given.items():
        known = READING[name]
        if value in (None, "", False):
            continue
        if name in ("swap_sides", "raw", "allow_pickle"):
            out[name] = bool(value)
        elif name == "fps":
            out[name] = _number(value, name, 0.1, 10_000)
        elif known is not None:
            if value not in known:
                raise _wrong(name)
            out[name] = value
        else:
            if not isinstance(value, str) or not re.fullmatch(r"[\w.+ -]{1,80}", value):
                raise _wrong(name)
            out[name] = value
    return out


def reading_words(reading: Mapping[str, Any]) -> list[str]:
    """The options that say so."""
    words: list[str] = []
    for name, value in reading.items():
        flag = "--" + name.replace("_", "-")
        words += [flag] if value is True else [f"{flag}={_text(value)}"]
    return words


def words_of(
    action: Action, given: Any, frames: int, onto: Mapping[str, Path], boxes: Path
) -> list[str]:
    """The options of a button that its settings come to.

    Args:
        given: what the page sends, by field. frames: of the motion. onto: files by take. boxes: the file
            of boxes beside the motion, if there are any.

    Raises:
        PoiseError: a setting that is unknown, missing or makes no sense.
    """
    if not isinstance(given, Mapping):
        raise _wrong("settings")
    known = {f.name: f for f in action.fields}
    if strange := next((k for k in given if k not in known), None):
        what = f"'{str(strange)[:40]}' is no setting of {action.label}"
        raise PoiseError(what, code="unknown-setting")
    words = list(action.words)
    for name, f in known.items():
        value = given.get(name, f.default)
        if value is None or value in ([], (), "") or (value == f.default and not f.always):
            continue
        words += _words(f, value, frames, onto, boxes)
    return words


def _words(f: Field, value: Any, frames: int, onto: Mapping[str, Path], boxes: Path) -> list[str]:
    flag = "--" + (f.flag or f.name)
    match f.kind:
        case "number":
            number = _number(value, f.label, f.low, f.high)
            return [flag, _text(round(number) if f.whole else number)]
        case "choice":
            if value not in [c for c, _ in f.choices]:
                raise _wrong(f.label)
            return [flag, value]
        case "flag":
            return [flag] if bool(value) != f.negative else []
        case "take":
            if not isinstance(value, str) or value not in onto:
                raise PoiseError("the rig is no motion of this project", code="unknown-take")
            return [flag, str(onto[value])]
        case "frames":
            rows = sorted({_frame(v, frames) for v in _items(value, f.label)})
            joined = "-" if f.flag == "frames" else ","
            return [flag, joined.join(map(str, rows))]
        case "vector":
            rows = [_number(v, f.label, -1e5, 1e5) for v in _items(value, f.label)]
            # A value that begins with - would be an option.
            return [f"{flag}={('-' if f.flag == 'range' else ',').join(_text(v) for v in rows)}"]
        case "spans":
            out: list[str] = []
            for limb, first, last in (_items(v, f.label, 3) for v in _items(value, f.label)):
                if limb not in LIMBS:
                    raise _wrong(f.label)
                out += [flag, f"{limb}:{_frame(first, frames)}-{_frame(last, frames)}"]
            return out
        case "touches":
            out = []
            for limb, frame, x, y, z in (_items(v, f.label, 5) for v in _items(value, f.label)):
                if limb not in TOUCHED:
                    raise _wrong(f.label)
                point = ",".join(_text(_number(v, f.label, -1e4, 1e4)) for v in (x, y, z))
                out += [flag, f"{limb}:{_frame(frame, frames)}:{point}"]
            return out
        case "boxes":
            return [flag, str(boxes)]
        case "maps":
            rows = [str(v) for v in _items(value, f.label)]
            if not all(
                a and b and _JOINT.fullmatch(a) and _JOINT.fullmatch(b)
                for a, _, b in (r.partition("=") for r in rows)
            ):
                raise _wrong(f.label)
            return [f"{flag}={row}" for row in rows]


def suffix_for(action: Action, home: str, onto: Path | None) -> str:
    """The suffix of the motion that a button writes: that of the skeleton's own format."""
    if action.name != "rig" or onto is None:
        return home
    gltf, usd = (".glb", ".gltf", ".vrm"), (".usd", ".usda", ".usdc")
    suffix = onto.suffix.lower()
    return ".glb" if suffix in gltf else ".usda" if suffix in usd else ".bvh"


def _items(value: Any, label: str, count: int | None = None) -> Sequence[Any]:
    if not isinstance(value, list | tuple) or len(value) > MOST_ITEMS or count not in (None, len(value)):
        raise _wrong(label)
    return value


def _frame(value: Any, frames: int) -> int:
    return round(_number(value, "frame", 0, max(frames - 1, 0)))


def _number(value: Any, label: str, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _wrong(label)
    if not low <= value <= high:
        raise PoiseError(f"{label} must lie in {low:g} to {high:g}, got {value:g}", code="out-of-range")
    return float(value)


def _text(value: Any) -> str:
    """A number as short as it is exact to a tenth of a millimetre; words as they are."""
    if isinstance(value, float):
        return f"{value:.4f}".rstrip("0").rstrip(".") if abs(value) >= 1e-4 else "0"
    return str(value)


def _wrong(label: str) -> PoiseError:
    return PoiseError(f"{label}: this value makes no sense", code="setting-malformed")
