"""The vertical of a file that states none: by what bears weight, by posture, by the rest pose.

Whatever bears weight keeps one height, stands still while it does, and lies under the body, averaged
over time: by Newton's law a body falls over if its weight lies beside its supports. Of the six
directions of a file's axes the true one fulfils that best, also of a body that lies or crawls;
a body that stands still fulfils it along several axes, and there its posture decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from poise.motion.info import landmarks
from poise.motion.io.guess import UPS, Guess

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
class Support:
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


def supports(names: Sequence[str], positions: np.ndarray, later: np.ndarray) -> dict[str, Support]:
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
            out[up] = Support(float(np.ptp(low)) / size, 1.0, 0.0, apart, creep, slide, head)
            continue
        wander = float(np.subtract(*np.percentile(low[borne], [95, 5]))) / size
        flat = [k for k in range(3) if k != c]
        places, at = positions[borne][..., flat], weight[borne][:, flat]
        mask = still[borne][..., None]
        under = np.where(mask, places, np.inf).min(1) - _REACH * size
        over = np.where(mask, places, -np.inf).max(1) + _REACH * size
        beside = np.maximum(at - over, 0.0) - np.maximum(under - at, 0.0)
        off = float(np.linalg.norm(beside.mean(0))) / size
        out[up] = Support(wander, off, float(borne.mean()), apart, creep, slide, head)
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
    best: str, second: str, moving: str | None, resting: str | None, borne: Support, margin: float
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
