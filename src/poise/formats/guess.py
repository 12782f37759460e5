"""Guesses about what motion files do not state, each with its evidence in one sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from poise.errors import PoiseError
from poise.formats.text import listed
from poise.motion.clip_info import landmarks
from poise.motion.rotations import quat_angle, quat_conj, quat_mul

UPS = ("Y", "Z", "X", "-Y", "-Z", "-X")
"""Verticals that a file may have; with "-" the axis points down."""

ASF_UNIT_M = 0.0254 / 0.45
"""Metres in the unit of the CMU library's ASF files (`length 0.45`, inches)."""

UNITS = {
    "metres": 1.0,
    "centimetres": 0.01,
    "millimetres": 0.001,
    "inches": 0.0254,
    "decimetres": 0.1,
    "feet": 0.3048,
    "ASF units": ASF_UNIT_M,
}
# How usual a unit is in files; those of the Acclaim system are the CMU library's as a rule.
_USUAL = {"inches": 0.1, "ASF units": 0.03, "decimetres": 0.03, "feet": 0.02}
_USUAL_ASF = {**_USUAL, "ASF units": 1.0}
# Densities (per m) of heights in motion files: grown-ups about 1.72 m, some children, few others.
_GROWN_M, _SPREAD_M = 1.72, 0.12
_BANDS = (
    *(((0.75, 1.5), 0.07), ((0.6, 0.75), 0.02), ((0.5, 0.6), 0.004)),
    *(((2.0, 2.3), 0.004), ((2.3, 3.0), 0.001)),
)
# A unit that is so many times likelier than the next one is sure.
_CLEARLY = 20.0
_GUESS_BAND = (0.5, 3.0)
_STATED_BAND = (0.3, 4.0)

_REST_ANGLE = np.radians(15.0)
_TELEPORT_SPEED = 6.0


@dataclass(frozen=True)
class Guess:
    """A value and the sentence that tells why, empty where the value is a stated one."""

    value: float | str
    note: str = ""


def stated_unit(height: float, unit_m: float, path: Path) -> Guess:
    """The unit the user stated, refused if the person's size becomes absurd."""
    size = height * unit_m
    if _STATED_BAND[0] <= size <= _STATED_BAND[1]:
        return Guess(unit_m)
    best, metres = _ranked(height)[0]
    raise PoiseError(
        f"with {unit_m:g} m per unit the person would be {_size(size)} tall",
        path,
        f"Give another --unit METRES_PER_UNIT; {best} ({metres:.6g}) would make it "
        f"{_size(height * metres)}",
        code="unit-implausible",
    )


def guess_unit(height: float, how: str, hint: float | None, path: Path, form: str = "") -> Guess:
    """Metres per unit from the skeleton's height in file units.

    A unit that the file itself suggests (`hint`) is kept if it makes a plausible person. Otherwise the
    one that is usual in the format `form` and makes a person of a usual size; one that is about as
    likely is named.
    """
    if hint is not None and _GUESS_BAND[0] <= height * hint <= _GUESS_BAND[1]:
        return Guess(
            hint,
            f"One file unit is taken as {hint:.6g} m by the file's `length` entry: the person is then "
            f"{height * hint:.2f} m tall ({how})",
        )
    ranked = _ranked(height, how, form)
    best, metres = ranked[0]
    size = height * metres
    if not _GUESS_BAND[0] <= size <= _GUESS_BAND[1]:
        raise PoiseError(
            f"the person is {height:.4g} file units tall, which is no human size in any known unit: "
            f"the nearest guess, {best}, makes it {_size(size)}",
            path,
            "State the unit with --unit METRES_PER_UNIT",
            code="unit-unknown",
        )
    told = f"The file states no unit: {best} taken, which make the person {size:.2f} m tall ({how})"
    other, metres_of_other = ranked[1]
    if _CLEARLY * _likely(height, other, how, form) > _likely(height, best, how, form):
        told += (
            f"; uncertain, since {other} would make it {height * metres_of_other:.2f} m "
            f"(--unit {metres_of_other:.6g})"
        )
    return Guess(metres, told)


def _likely(height: float, unit: str, how: str, form: str) -> float:
    """How likely a unit is for a height in file units: how usual it is, times how many are so tall."""
    size = height * UNITS[unit]
    spread = _SPREAD_M if "bones" in how else 2.0 * _SPREAD_M
    grown = np.exp(-0.5 * ((size - _GROWN_M) / spread) ** 2) / (spread * np.sqrt(2.0 * np.pi))
    rare = sum(density for (low, high), density in _BANDS if low <= size <= high)
    if not _GUESS_BAND[0] <= size <= _GUESS_BAND[1]:
        # Beyond all people the nearest unit is named.
        return 1e-30 * float(np.exp(-abs(np.log(size / _GROWN_M))))
    return (_USUAL_ASF if form == "asf-amc" else _USUAL).get(unit, 1.0) * float(grown + rare + 1e-6)


def _ranked(height: float, how: str = "bones", form: str = "") -> list[tuple[str, float]]:
    """The units with their metres, the likeliest for a height in file units first."""
    order = sorted(UNITS, key=lambda unit: -_likely(height, unit, how, form))
    return [(unit, UNITS[unit]) for unit in order]


def _size(metres: float) -> str:
    return f"{metres:.3g} m" if metres >= 0.1 else f"{metres * 1e3:.3g} mm"


def inserted_rest_frames(rot: np.ndarray) -> tuple[int, str]:
    """How many frames of a rest pose were put before the motion, and a sentence about them; 0 if none.

    Frame 0 is one when its root is unturned and its joints are near their rest rotations, and from it to
    frame 1 the root (or the mean joint) turns far more than from frame to frame afterwards. Some
    converters smooth over that jump: frames in which the joints go on easing out of it, by ever smaller
    steps that are all far greater than usual, are no motion either.
    """
    if len(rot) < 4:
        return 0, ""
    q = np.asarray(rot[:40], dtype=float)
    steps = quat_angle(quat_mul(quat_conj(q[:-1]), q[1:]))
    from_rest = quat_angle(q[0])
    if from_rest[0] > np.radians(0.5) or from_rest.mean() > _REST_ANGLE:
        return 0, ""
    root, joints = steps[:, 0], steps[:, 1:].mean(-1) if steps.shape[1] > 1 else steps[:, 0]
    # What is usual shows behind the frames that ease, which turn fast themselves.
    usual_root, usual = (
        min(np.median(x[1:12]), np.median(x[20:]) if len(x) > 24 else np.inf) for x in (root, joints)
    )
    root_jumps = root[0] > 6.0 * usual_root + np.radians(5.0)
    joints_jump = joints[0] > 6.0 * usual + np.radians(2.0)
    if not (root_jumps or joints_jump):
        return 0, ""
    easing = 0
    if len(joints) > 24:
        large = joints[1:20] > 2.0 * np.median(joints[20:]) + np.radians(0.2)
        falling = np.concatenate(([True], joints[2:20] < joints[1:19]))
        easing = int(np.cumprod(large & falling).sum())
    if not easing:
        return 1, "Frame 0 is a rest pose that was put before the motion; it was dropped"
    return 1 + easing, (
        f"Frame 0 is a rest pose that was put before the motion, and up to frame {easing} the joints "
        f"ease out of it; these {1 + easing} frames were dropped"
    )


def root_jumps(root_pos: np.ndarray, fps: float) -> list[tuple[int, float]]:
    """(frame, metres) wherever the root path `(T, 3)` m gets in one step farther than a body can.

    Such a step exceeds 6 m/s and five times the usual step of the frames around it.
    """
    step = np.linalg.norm(np.diff(root_pos, axis=0), axis=-1)
    fast = step * fps > _TELEPORT_SPEED
    if len(step) < 3 or not fast.any():
        return []
    half = max(3, round(0.25 * fps))
    padded = np.pad(step, half, mode="reflect" if len(step) > half else "edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
    usual = np.concatenate([np.median(part, axis=-1) for part in np.array_split(windows, 16)])
    found = np.flatnonzero(fast & (step > 5.0 * usual))
    return [(int(f) + 1, float(step[f])) for f in found]


def teleports(root_pos: np.ndarray, fps: float) -> list[str]:
    """A sentence about the `root_jumps`: frames, metres."""
    found = root_jumps(root_pos, fps)
    if not found:
        return []
    jumps = listed((f"{frame} ({size:.2f} m)" for frame, size in found), 12)
    return [f"The root jumps at frame{'' if len(found) == 1 else 's'} {jumps}; the jumps were kept"]


#: Seconds between a pose and the later one that tells what stands still.
LATER_S = 0.1
# Shares of the body's size: how far above the lowest point others bear weight as well, how far a point
# gets in `LATER_S` that stands still, how far soles and palms reach beyond their joints.
_NEAR, _STILL, _REACH = 0.06, 0.02, 0.1
# The same: what stands still while a trunk moves by twice as much, and the most that creeping counts.
_HELD, _CREEPS = 0.003, 0.03
# What a posture is worth against the supports (shares of the size, like their cost), and what an unusual
# axis costs. A rest pose along Y tells less: templates stand so in files of any vertical.
_STANDS, _RESTS, _RESTS_Y = 0.12, 0.16, 0.10
_UNUSUAL = {"Y": 0.0, "Z": 0.0, "X": 0.1, "-Y": 0.08, "-Z": 0.1, "-X": 0.2}
# Motion and rest pose that agree are doubted by supports that say otherwise, and seldom overruled.
_AGREE = 0.25
# A head that is lowest without hands beside it bears no body.
_ON_HEAD = 0.5
#: A guess that is better than the next one by less is uncertain.
SURE = 0.15
_HIPS = ("hip", "upleg", "upperleg", "thigh", "femur")
_ARMS = ("shoulder", "upperarm", "uparm", "humerus", "shldr")
_HANDS = ("hand", "wrist")


@dataclass(frozen=True)
class BorneBy:
    """How a body is borne if one axis is the vertical; shares of its size.

    wander: how much the height of what bears it varies. off: how far its weight lies beside it, averaged
    over time. share: part of the frames in which something that bears it stands still. apart: how much
    the heights of hands and feet differ that stand still while the trunk moves. creep: how far the
    slowest supporting point gets in `LATER_S` in the mean. slide: the same over what the body does.
    """

    wander: float
    off: float
    share: float
    apart: float
    creep: float
    slide: float
    on_head: bool = False

    @property
    def firm(self) -> bool:
        """Whether something that bears the body stands still nearly always."""
        return self.slide < 0.5 and self.share > 0.8

    @property
    def cost(self) -> float:
        """0 where the axis bears the body as the ground does."""
        lost = 0.5 * (1.0 - self.share) + _ON_HEAD * self.on_head
        return self.wander + self.off + 0.4 * self.apart + 10.0 * self.creep + lost


def supports(names: Sequence[str], positions: np.ndarray, later: np.ndarray) -> dict[str, BorneBy]:
    """The support of a body by each of `UPS`, from poses `(S, J, 3)` and those `LATER_S` later."""
    size = max(float(np.median(np.linalg.norm(np.ptp(positions, axis=1), axis=-1))), 1e-12)
    weight = _weight(names, positions)
    moved = np.linalg.norm(later - positions, axis=-1) / size
    heads, _, feet = landmarks(names)
    hands = _named(names, _HANDS)
    ends = [*hands, *feet]
    trunk = [moved[:, at].min(1) for at in (_named(names, _HIPS), _named(names, _ARMS)) if at]
    holding = np.zeros((len(moved), len(ends)), dtype=bool)
    if len(trunk) == 2:
        holding = (moved[:, ends] < _HELD) & (np.minimum(*trunk) > 2 * _HELD)[:, None]
    out = {}
    for up in UPS:
        c = "XYZ".index(up[-1])
        height = positions[..., c] * (-1.0 if up[0] == "-" else 1.0)
        low = height.min(1)
        near = height < low[:, None] + _NEAR * size
        still = near & (moved < _STILL)
        borne = still.any(1)
        slowest = np.where(near, moved, np.inf).min(1)
        slide = float(slowest.mean() / max(np.median(moved, axis=1).mean(), 1e-9))
        creep = float(np.minimum(slowest, _CREEPS).mean())
        apart = _apart(height[:, ends], holding) / size
        head = bool(heads and hands) and bool(
            np.median(height[:, heads[0]] - height[:, hands].min(1)) < -_REACH * size / 2
            and np.median(height[:, heads[0]] - low) < 2 * _REACH * size
        )
        if not borne.any():
            out[up] = BorneBy(float(np.ptp(low)) / size, 1.0, 0.0, apart, creep, slide, head)
            continue
        wander = float(np.subtract(*np.percentile(low[borne], [95, 5]))) / size
        flat = [k for k in range(3) if k != c]
        places, at = positions[borne][..., flat], weight[borne][:, flat]
        mask = still[borne][..., None]
        under = np.where(mask, places, np.inf).min(1) - _REACH * size
        over = np.where(mask, places, -np.inf).max(1) + _REACH * size
        beside = np.maximum(at - over, 0.0) - np.maximum(under - at, 0.0)
        off = float(np.linalg.norm(beside.mean(0))) / size
        out[up] = BorneBy(wander, off, float(borne.mean()), apart, creep, slide, head)
    return out


def _apart(height: np.ndarray, mask: np.ndarray) -> float:
    """The spread of heights `(S, N)` where `mask` is true in two places at least, averaged over S."""
    some = mask.sum(1) > 1
    if not some.any():
        return 0.0
    spread = np.where(mask, height, -np.inf).max(1)[some] - np.where(mask, height, np.inf).min(1)[some]
    return float(spread.sum()) / len(height)


def later_frames(at: np.ndarray, fps: float, frames: int) -> np.ndarray:
    """The frames `LATER_S` after `at`, none beyond the last of a motion."""
    step = max(1, round(min(LATER_S * fps, float(frames)))) if fps > 0 else 1
    return np.minimum(at + step, frames - 1)


def _named(names: Sequence[str], words: Sequence[str]) -> list[int]:
    low = [n.lower().rsplit(":", 1)[-1] for n in names]
    return [j for j, n in enumerate(low) if any(w in n for w in words)]


def _weight(names: Sequence[str], positions: np.ndarray) -> np.ndarray:
    """`(S, 3)` about where the body's weight lies: between hips and neck, or amid the joints."""
    heads, necks, _ = landmarks(names)
    hips, tops = _named(names, _HIPS), necks or heads
    if not (hips and tops):
        return positions.mean(1)
    return 0.6 * positions[:, hips].mean(1) + 0.4 * positions[:, tops[0]]


def lean(names: Sequence[str], positions: np.ndarray) -> np.ndarray:
    """`(3,)` the mean direction of the bodies `(S, J, 3)` from ankles to head, as long as they agree.

    Where names tell nothing: how far the body reaches along each axis, without a sense.
    """
    heads, necks, ankles = landmarks(names)
    tops = heads or necks
    if tops and ankles:
        way = positions[:, tops[0]] - positions[:, ankles].mean(1)
        return (way / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-12)).mean(0)
    extent = (positions.max(1) - positions.min(1)).mean(0)
    return extent / max(float(np.linalg.norm(extent)), 1e-12)


def clear_axis(way: np.ndarray) -> str | None:
    """The one of `UPS` along which a mean direction `(3,)` clearly goes, None where none is clear."""
    size = np.abs(way)
    first, second = np.argsort(-size)[:2]
    if size[second] > 0.7 * size[first] or size[first] < 0.5:
        return None
    return ("-" if way[first] < 0 else "") + "XYZ"[first]


def guess_up(
    names: Sequence[str],
    positions: np.ndarray,
    rest: np.ndarray | None = None,
    later: np.ndarray | None = None,
) -> Guess:
    """The vertical of a file, one of `UPS`, with its evidence.

    Whatever bears weight keeps one height, stands still while it does, and lies under the body, averaged
    over time: by Newton's law a body falls over if its weight lies beside its supports. Of the six
    directions of a file's axes the true one fulfils that best, also where a body lies or crawls. A body
    that stands still fulfils it along several axes, and there its posture decides.

    Args:
        positions: `(S, J, 3)` poses out of the motion. later: the same `LATER_S` later.
        rest: `(J, 3)` the rest pose, None where the file has none.
    """
    first = max(1, len(positions) // 10)
    moving = clear_axis((lean(names, positions[:first]) + lean(names, positions)) / 2)
    resting = None if rest is None else clear_axis(lean(names, rest[None]))
    if resting is not None and resting[-1] == "X" and resting != moving:
        # Folded rest poses point anywhere.
        resting = None
    borne = supports(names, positions, positions if later is None else later)
    score = {up: s.cost + _UNUSUAL[up] for up, s in borne.items()}
    if moving is not None:
        on = borne[moving]
        if moving[0] != "-" and on.slide >= 0.8 and on.wander < _NEAR and not on.on_head:
            # Motion in place, or relative to the pelvis: the feet slide, and keep their height.
            score[moving] = on.wander + _UNUSUAL[moving]
        score[moving] -= _STANDS
    if resting is not None:
        score[resting] -= _RESTS_Y if resting == "Y" else _RESTS
    plain = dict(score)
    if moving is not None and moving == resting:
        score[moving] -= _AGREE
    # A clear posture is overruled only by an axis along which the body is borne as by the ground.
    tried = [up for up in UPS if moving is None or up in (moving, resting) or borne[up].firm]
    best = min(tried, key=score.__getitem__)
    others = [up for up in tried if up != best]
    second = min(others or [up for up in UPS if up != best], key=plain.__getitem__)
    margin = plain[second] - plain[best] if others else np.inf
    return Guess(best, _why(best, second, moving, resting, borne[best], float(margin)))


def _why(
    best: str, second: str, moving: str | None, resting: str | None, borne: BorneBy, margin: float
) -> str:
    """The sentence about a vertical that is not plain to see."""
    agree = moving == resting == best
    sure = margin > SURE and (agree or borne.slide < 0.8)
    why = []
    if moving == best:
        why.append("the body stands along it")
    elif moving is not None and moving[-1] == best[-1]:
        why.append("what bears the body keeps its height and its place there, under a head that is down")
    elif moving is not None:
        why.append(
            f"what bears the body keeps one height along it, while the body lies along {moving[-1]}"
        )
    if resting == best and not agree:
        why.append("the rest pose stands along it")
    reason = " and ".join(why) or "the lowest points keep one height and stand still along it"
    text = f"The file states no vertical: {best} taken, since {reason}"
    if best[0] == "-":
        text += f"; along {best[1]} alone it would be head down, and was turned over"
    if sure and moving == best:
        return text
    other = moving if moving not in (best, None) else second
    return f"{text} (uncertain; override with --up {other})"


_TURN = 2.0 * np.pi
#: Share of the frames in which a joint must be turned by more than a whole turn; a few may be damaged.
_OFTEN = 0.05
#: A motion in radians read as degrees keeps every angle below this (degrees) ...
_FEW_DEG = 3.5
#: ... although two joints and more turn by this (radians) at least, if they are radians.
_MOVES_RAD, _JOINTS = 0.35, 2


def check_radians(angles: Mapping[str, np.ndarray], stated: str, path: Path, hint: str) -> None:
    """Refuses radians of which one turns a joint by more than a whole turn again and again: degrees.

    Args:
        angles: `(T, ...)` rad by the joint's name. Roots, which may turn often, are left out.
        stated: what tells that they are radians, for the sentence. hint: what to change.

    Raises:
        PoiseError: naming the joint, the frame and the value.
    """
    worst = ("", 0, 0.0)
    for name, values in angles.items():
        if not values.size:
            continue
        size = np.abs(values).reshape(len(values), -1).max(-1)
        if (size > _TURN).mean() >= _OFTEN and size.max() > worst[2]:
            worst = (name, int(size.argmax()), float(size.max()))
    if worst[0]:
        name, frame, value = worst
        raise PoiseError(
            f"'{name}' is {value:.4g} at frame {frame}, {value / _TURN:.1f} whole turns of a joint in "
            f"radians, which {stated}: the angles seem to be degrees",
            path,
            hint,
            code="degrees-as-radians",
        )


def few_degrees(angles: Mapping[str, np.ndarray]) -> tuple[str, float] | None:
    """The joint that moves most and its largest angle, if angles that are said to be degrees look like
    radians: all are tiny, and several joints would move well if they were radians.

    angles: `(T, ...)` by the joint's name, without roots.
    """
    tables = {n: v.reshape(len(v), -1) for n, v in angles.items() if v.size}
    if not tables or max(np.abs(v).max() for v in tables.values()) > _FEW_DEG:
        return None
    moves = {n: float(np.ptp(v, axis=0).max()) for n, v in tables.items()}
    if sum(x > _MOVES_RAD for x in moves.values()) < _JOINTS:
        return None
    most = max(moves, key=moves.__getitem__)
    return most, float(np.abs(tables[most]).max())


def few_degrees_note(angles: Mapping[str, np.ndarray]) -> list[str]:
    """The sentence about angles in degrees that look like radians, for formats that state no unit."""
    found = few_degrees(angles)
    if found is None:
        return []
    return [
        f"No joint turns by more than {_FEW_DEG:g} degrees ('{found[0]}' most, to {found[1]:.3g}): the "
        "angles look like radians, but were read as degrees, as the format has them (uncertain; write "
        "degrees)"
    ]
