"""The buttons of the page: the verb that each runs, its settings, and the command line that comes of them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from poise.errors import PoiseError
from poise.live.open.project import suffix_of

Kind = Literal["number", "choice", "flag", "take", "frames", "spans", "touches", "vector", "boxes", "maps"]
LIMBS = ("left_hand", "right_hand", "left_foot", "right_foot")
PARTS = (
    "left_hand", "right_hand", "left_elbow", "right_elbow", "left_shoulder", "right_shoulder", "head",
    "chest", "pelvis", "left_hip", "right_hip", "left_knee", "right_knee", "left_foot", "right_foot",
)  # fmt: skip
TOUCHED = (*LIMBS, "pelvis")
MOST_ITEMS = 500
_JOINT = re.compile(r"[\w:.| -]{1,80}", re.ASCII)


@dataclass(frozen=True)
class Field:
    """A setting of a button.

    Attributes:
        name: as the page sends it; `flag` is the option of the command line, by default the same.
        label: for people; text: a sentence on it.
        kind: number; choice; flag; take: a motion of the project; frames: numbers of frames; spans: limbs
            with two frames; touches: limbs with a frame and a point; vector; boxes: what a motion rests
            on; maps: pairs of joints.
        default: the command line says nothing where the value is this. low, high, step: of a number.
        whole: a number without a fraction. advanced: shown in a fold.
        negative: the flag is said where the value is off. always: said also where it is the default, since
            that of the command line is another one.
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


_HOLD = Field(
    "hold_feet", "Hold standing feet", "flag", True, "Standing feet are held to the spot in what is written.",
    advanced=True, flag="no-hold-feet", negative=True,
)  # fmt: skip
_SEED = Field("seed", "Seed", "number", 0, "Another one gives another take.", 0, 1e6, whole=True, advanced=True)
_PLACE = Field(
    "in_place", "Walks in place", "choice", "auto", "Whether a motion in place gets the travel of its feet.",
    choices=(("auto", "give it travel, write it in place"), ("travel", "write it with travel"),
             ("keep", "simulate it in place")), advanced=True, flag="in-place",
)  # fmt: skip
_BUDGET = Field(
    "budget", "Care", "number", 192, "Simulated steps of lookahead for each that is made; more are nearer.",
    16, 4096, 16, whole=True, advanced=True,
)  # fmt: skip
_BODY = Field(
    "body", "Body", "choice", "policy", "The body that is simulated.",
    choices=(("policy", "the policy's own, retargeted"), ("own", "lengths and masses of this skeleton")),
    advanced=True,
)  # fmt: skip
_CONTROLLER = Field(
    "controller", "How well", "choice", "auto", "How it is found.",
    choices=(("auto", "well: looks ahead, searches what is lost"), ("policy", "quick: the policy alone")),
)  # fmt: skip
_PINS = Field("pins", "Stay put", "spans", (), "Hands or feet that stay where they are.", flag="pin")
_TOUCHES = Field("touches", "Touch", "touches", (), "Points that hands, feet or pelvis reach.", flag="touch")
_SUPPORTS = Field(
    "supports", "Put what it rests on", "flag", True, "A box stands where the motion sits or leans.",
    advanced=True, flag="no-supports", negative=True,
)  # fmt: skip

ACTIONS: dict[str, Action] = {
    a.name: a
    for a in (
        Action(
            "mend", "Mend", "Take off slides, floats, jitter and jumps. Seconds.", "doctor", "mended",
            (
                Field("path", "Path", "choice", "auto", "Whether the root's way may be mended too.",
                      choices=(("auto", "where both feet tell the same drift"), ("keep", "leave the root's path"),
                               ("mend", "take off the drift of standing feet"))),
                Field("rest_pose", "Give it a T-pose", "flag", False, "A rest pose that other tools understand.",
                      advanced=True, flag="rest-pose"),
            ),
            ("--fix",),
        ),
        Action(
            "body", "Give it a body", "A simulated body does the motion, without help. A minute or so.",
            "track", "with a body",
            (_CONTROLLER, _PINS, _TOUCHES, _SUPPORTS, _BODY, _PLACE, _BUDGET, _HOLD, _SEED), folder=True,
        ),
        Action(
            "rig", "Onto my rig", "Move it onto another skeleton, feet kept where they stand. Seconds.",
            "retarget", "on a rig",
            (
                Field("onto", "Rig", "take", "", "A file with the skeleton that shall move.", flag="onto"),
                Field("contacts", "Keep standing feet", "flag", True, "Standing feet and hands are held.",
                      advanced=True, flag="no-contacts", negative=True),
                Field("maps", "Joints", "maps", (), "A joint here and the joint that it moves: Arm_L=upperarm_l.",
                      advanced=True, flag="map"),
            ),
        ),
        Action(
            "between", "Between keys", "Make everything between frames that stay. A minute or so.", "complete",
            "between keys",
            (
                Field("keyframes", "Frames that stay", "frames", (), "Mark them on the timeline with S.",
                      flag="keyframes"),
                Field("kinematic", "Without a body", "flag", False, "Only fill; keyframes are met exactly.",
                      flag="kinematic"),
                _PINS, _TOUCHES,
                Field("retime", "Take more time if needed", "flag", False,
                      "Gaps that no body does in their time get more of it.", advanced=True, flag="retime"),
                _HOLD, _SEED,
            ),
            folder=True,
        ),
        Action(
            "push", "Push here", "Push the body at this frame; it gives way and comes back. A minute or so.",
            "push", "pushed",
            (
                Field("at", "Where", "choice", "chest", "The part that is pushed; or drag on the figure.",
                      choices=tuple((p, p.replace("_", " ")) for p in PARTS), always=True),
                Field("force", "Force", "number", 150.0, "How hard.", 1, 5000, 10, "N"),
                Field("start", "Begins", "number", 1.0, "When it begins: at the frame that is shown.", 0, 1e5,
                      0.01, "s", flag="from"),
                Field("seconds", "Lasts", "number", 0.5, "How long it lasts.", 0.02, 60, 0.05, "s"),
                Field("level", "Gives way", "number", 0.12, "0 is stiff; above 0.2 joints turn far.", 0, 1, 0.01),
                Field("direction", "Towards", "vector", None,
                      "By default from the front; drag the arrow on the figure."),
                Field("controller", "How well", "choice", "lookahead", "How it is found.",
                      choices=(("lookahead", "well: looks ahead"), ("policy", "quick: the policy alone"))),
                _BODY, _PLACE, _HOLD, _SEED,
            ),
            folder=True,
        ),
        Action(
            "chair", "Put a chair", "Find what the motion rests on, move it if it is wrong, let the body sit.",
            "track", "on a chair",
            (
                Field("boxes", "Boxes", "boxes", (), "What stands there; drag it on the stage.", flag="support"),
                _CONTROLLER, _BODY, _BUDGET, _HOLD, _SEED,
            ),
            folder=True,
        ),
        Action(
            "range", "Only this range", "Do only the marked range anew; the rest stays as it is.", "track",
            "range anew",
            (
                Field("span", "Range", "vector", None, "In s, from the timeline.", flag="range"),
                _PINS, _TOUCHES, _BUDGET, _HOLD,
                Field("seed", "Seed", "number", 1, "Another one gives another take.", 0, 1e6, whole=True,
                      always=True),
            ),
            folder=True, needs=True,
        ),
        Action(
            "cut", "Cut out", "Keep only the marked range.", "convert", "cut",
            (Field("frames", "Frames", "frames", (), "First and last frame.", flag="frames"),),
        ),
    )
}  # fmt: skip
#: Formats of an export, by suffix.
EXPORTS = {
    ".bvh": "BVH", ".fbx": "FBX", ".glb": "GLB", ".usda": "USD", ".npz": "npz (AMASS or Poise)", ".csv": "CSV",
}  # fmt: skip
#: What may be stated of a file, by the name of its option.
READING: dict[str, tuple[str, ...] | None] = {
    "up": ("Y", "Z", "X", "-Y", "-Z", "-X"), "unit": None, "fps": None, "ground": None, "take": None,
    "swap_sides": None, "raw": None, "allow_pickle": None,
}  # fmt: skip


def told() -> list[dict[str, Any]]:
    """The buttons for the page."""

    def row(value: Any) -> Any:
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return [
        {
            "name": a.name, "label": a.label, "text": a.text, "verb": a.verb, "words": a.words,
            "needs": a.needs, "fields": [{k: row(v) for k, v in asdict(f).items()} for f in a.fields],
        }
        for a in ACTIONS.values()
    ]  # fmt: skip


def reading_of(given: Any) -> dict[str, Any]:
    """What is stated of a file, checked.

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


def words_of(action: Action, given: Any, frames: int, onto: Mapping[str, Path], boxes: Path) -> list[str]:
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
        raise PoiseError(f"'{str(strange)[:40]}' is no setting of {action.label}", code="unknown-setting")
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
            if value not in onto:
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
            if not all(a and b and _JOINT.fullmatch(a) and _JOINT.fullmatch(b) for a, _, b in
                       (r.partition("=") for r in rows)):  # fmt: skip
                raise _wrong(f.label)
            return [w for r in rows for w in (flag, r)]


def suffix_for(action: Action, home: str, onto: Path | None) -> str:
    """The suffix of the motion that a button writes: that of the skeleton's own format."""
    if action.name != "rig" or onto is None:
        return home
    kept = {".glb": ".glb", ".gltf": ".glb", ".vrm": ".glb", ".usd": ".usda", ".usda": ".usda", ".usdc": ".usda"}
    return kept.get(suffix_of([onto.name]), ".bvh")


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
