"""Faults of a motion's frames: repeated and missing ones, a path that jumps, a height that drifts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from poise.formats.guess import root_jumps
from poise.kinematics.feet import SAME_FLOOR_M
from poise.kinematics.ground import ALOFT_M
from poise.kinematics.repair.faults import Fault
from poise.motion import Clip
from poise.motion.rotations import quat_distance, slerp
from poise.motion.smoothing import find_runs, gaussian, smoothstep

#: A frame repeats the one before if no joint turns and the root does not move by more than this.
SAME_RAD, SAME_M = 1e-7, 1e-7
#: The body was moving around repeated frames if its mean joint turned at least this fast, rad/s.
MOVING = 0.05
#: A step counts as several if every joint's is this much larger than its neighbours', at this speed.
GAP_RATIO, GAP_SPEED = 1.7, 0.5
#: Jumps closer than this (s) belong together, and a closing gap is spread if it is slower than this.
TOGETHER_S, SPREAD_SPEED = 0.5, 1.0
#: The path's own velocity beside a jump is the mean over this time (s).
BESIDE_S = 0.05


class Hold(NamedTuple):
    """Frames `start` to `stop` repeat frame `start - 1`; `filled` if their time has passed meanwhile."""

    start: int
    stop: int
    filled: bool


def body_steps(clip: Clip) -> np.ndarray:
    """`(T - 1, J)` rad, how far every joint turns from frame to frame."""
    rot = clip.rot.copy()
    return quat_distance(rot[:-1], rot[1:])


def find_holds(clip: Clip) -> list[Hold]:
    """Runs of frames that repeat the one before while the body moves on both sides.

    Where the step out of the run is clearly larger than the usual one, frames were lost and their place
    was filled; otherwise the frames were put in between.
    """
    steps = body_steps(clip)
    moved = np.linalg.norm(np.diff(clip.root_pos, axis=0), axis=-1)
    same = (steps.max(-1) < SAME_RAD) & (moved < SAME_M)
    size = steps.mean(-1)
    reach = max(3, round(0.1 * clip.fps))
    out = []
    for first, last in find_runs(same, 0):
        before = size[max(first - reach, 0) : first]
        after = size[last + 1 : last + 1 + reach]
        before, after = before[before > SAME_RAD], after[after > SAME_RAD]
        if not len(before) or not len(after):
            continue
        usual = float(np.median(np.concatenate((before, after[1:] if len(after) > 1 else after))))
        if usual * clip.fps < MOVING:
            continue
        out.append(Hold(first + 1, last + 1, float(after[0]) > 1.5 * usual))
    return out


def find_gaps(clip: Clip) -> list[tuple[int, float]]:
    """(frame, how many usual steps) where the whole body gets in one step as far as in several.

    Most joints must step farther than on either side, so that a start or a stop is no gap. How many
    usual steps it holds is told by all joints together, the fast ones most.
    """
    steps = body_steps(clip)
    if len(steps) < 7:
        return []
    around = np.stack([np.roll(steps, k, axis=0) for k in (-3, -2, 2, 3)])
    near = np.stack([np.roll(steps, k, axis=0) for k in (-1, 1)])
    usual = np.maximum(np.median(around, axis=0), near.max(0))
    ratio = np.median(steps / np.maximum(usual, 1e-9), axis=-1)
    ratio[:3] = ratio[-3:] = 0.0
    fast = np.median(steps, axis=-1) * clip.fps > GAP_SPEED
    whole = steps.sum(-1) / np.maximum(np.median(around, axis=0).sum(-1), 1e-9)
    return [(int(t) + 1, float(whole[t])) for t in np.flatnonzero((ratio > GAP_RATIO) & fast)]


def timing_faults(clip: Clip) -> list[Fault]:
    """Frozen and missing frames, and root teleports."""
    out, holds = [], find_holds(clip)
    for h in holds:
        detail = "in the place of lost ones" if h.filled else "put in between"
        out.append(Fault("frozen frames", "", h.start, h.stop, h.stop - h.start + 1.0, detail))
    # The step out of a hold is told already.
    known = {h.stop + 1 for h in holds}
    for t, ratio in find_gaps(clip):
        if t not in known and round(ratio) > 1:
            detail = f"all joints step {ratio:.1f} times as far"
            out.append(Fault("missing frames", "", t, t, round(ratio) - 1.0, detail))
    root = clip.skeleton.names[0]
    jumps = root_jumps(clip.root_pos, clip.fps)
    out += [Fault("teleport", root, t, t, metres, f"in one frame to frame {t}") for t, metres in jumps]
    return out


def mend_holds(clip: Clip) -> Clip:
    """Repeated frames filled in by interpolation, or left out where they were put in between."""
    holds = find_holds(clip)
    root, rot = clip.arrays()
    keep = np.ones(clip.frames, dtype=bool)
    for hold in holds:
        if not hold.filled:
            keep[hold.start : hold.stop + 1] = False
            continue
        a, b = hold.start - 1, hold.stop + 1
        t = np.linspace(0.0, 1.0, b - a + 1, dtype=rot.dtype)[1:-1]
        rot[a + 1 : b] = slerp(rot[a], rot[b], t[:, None])
        share = t[:, None]
        root[a + 1 : b] = root[a] * (1 - share) + root[b] * share
    return clip.replaced(root_pos=root[keep], rot=rot[keep]) if holds else clip


def mend_teleports(clip: Clip, low: np.ndarray | None = None) -> Clip:
    """The root path with every jump replaced by the path's usual step there.

    Jumps within `TOGETHER_S` are one group. If they cancel (the path leaves and comes back), what is
    left of the gap behind the group is spread over it and the rest of the path stays where it was.
    Otherwise all that follows is moved: horizontally in any case, vertically only where the body's
    lowest point `low (T)` m jumped as well, so that it keeps its floor.
    """
    jumps = [t for t, _ in root_jumps(clip.root_pos, clip.fps)]
    if not jumps:
        return clip
    path = np.array(clip.root_pos)
    step = np.diff(path, axis=0)
    group = round(TOGETHER_S * clip.fps)
    bad = np.zeros(len(path), dtype=bool)
    bad[jumps] = True
    shift = np.zeros_like(path)
    for first, last in find_runs(bad, group):
        here = [t for t in jumps if first <= t <= last]
        moves = {t: _usual_step(step, bad, t, clip.fps) - step[t - 1] for t in here}
        gap = sum(moves.values(), np.zeros(3))
        own = np.zeros_like(path)
        for t, move in moves.items():
            own[t:] += move
        seconds = (last - first) / clip.fps
        if last > first and np.linalg.norm(gap) <= SPREAD_SPEED * seconds:
            share = np.clip((np.arange(len(path)) - first + 1) / (last - first + 1), 0.0, 1.0)
            own -= share[:, None] * gap
        elif low is not None and not _floor_jumped(low, first, last, -gap[2], clip.fps):
            # The height was right on both sides: it is blended from one to the other around the jump.
            reach = max(2, round(0.1 * clip.fps))
            back = np.clip((np.arange(len(path)) - last + reach) / (2 * reach), 0.0, 1.0)
            own[:, 2] -= smoothstep(back) * gap[2]
        shift += own
    return clip.replaced(root_pos=path + shift)


def _usual_step(step: np.ndarray, bad: np.ndarray, frame: int, fps: float) -> np.ndarray:
    """The mean step `(3)` beside the jump to `frame`, other jumps left out."""
    reach = max(2, round(BESIDE_S * fps))
    near = [
        k
        for k in range(frame - 1 - reach, frame + reach)
        if 0 <= k < len(step) and k != frame - 1 and not bad[k + 1]
    ]
    return np.median(step[near], axis=0) if near else np.zeros(3)


def _floor_jumped(low: np.ndarray, first: int, last: int, height: float, fps: float) -> bool:
    """Whether the body's lowest point jumps with the root by `height` m between two frames."""
    reach = max(3, round(fps))
    before, after = low[max(first - reach, 0) : first], low[last : last + reach]
    if not len(before) or not len(after):
        return True
    change = float(np.quantile(after, 0.1) - np.quantile(before, 0.1))
    return abs(change - height) < abs(change)


#: A drift of less (m) over the whole clip is none, and so is one of a clip that is shorter (s).
LEAST_M, LEAST_S = 0.1, 0.8
# A body on stairs or a slope is borne at one height for the time of each step. One that drifts moves up
# while it is borne: about as fast (shares of the whole clip's speed) in its usual frame as in the mean.
_USUAL = (0.7, 1.5)
# Share of the frames in which the lowest point keeps to the line, and deviation (s) of the smoothing.
_BORNE, _SMOOTH_S = 0.5, 0.05
#: A spell off the floor that is said to be none by its steady height alone: for so long (s), this fast.
HELD_S, RISES = 0.6, 0.02


class HeightDrift(NamedTuple):
    """speed: m/s, upwards. at_start: m, the drifting floor in frame 0. frames, fps: the clip's."""

    speed: float
    at_start: float
    frames: int
    fps: float

    @property
    def size_m(self) -> float:
        """How far the floor gets over the clip, m."""
        return self.speed * (self.frames - 1) / self.fps

    def heights(self) -> np.ndarray:
        """`(T)` m to take off, so that the floor stays where its line is nearest to zero."""
        line = self.at_start + self.speed * np.arange(self.frames) / self.fps
        stays = line[np.abs(line).argmin()] if line.min() > 0 or line.max() < 0 else 0.0
        return line - stays


def find_drift(low: np.ndarray, fps: float) -> HeightDrift | None:
    """The steady drift of the lowest points `(T)` m of a body, None where there is none.

    The line that the lower half of the points keep to must climb by `LEAST_M`, half of all points must
    lie on it, and in the usual frame on it the point must move as the line does.
    """
    frames = len(low)
    if frames < max(8, LEAST_S * fps):
        return None
    t, on = np.arange(frames) / fps, np.ones(frames, dtype=bool)
    speed = start = 0.0
    for _ in range(8):
        speed, start = np.polyfit(t[on], low[on], 1)
        over = low - (start + speed * t)
        # Swinging and flying bodies are above their floor, never below.
        on = over <= np.quantile(over, 0.6)
    drift = HeightDrift(float(speed), float(start), frames, fps)
    if abs(drift.size_m) < LEAST_M:
        return None
    over = low - (start + speed * t)
    over = over - np.median(over[on])
    near = np.abs(over) < SAME_FLOOR_M
    if near.mean() < _BORNE or np.quantile(over, 0.02) < -2.0 * SAME_FLOOR_M:
        return None
    window = gaussian(_SMOOTH_S * fps)
    smooth = np.convolve(np.pad(low, len(window) // 2, mode="edge"), window, "valid")
    steps = np.diff(smooth) * fps
    usual = float(np.median(steps[near[1:] & near[:-1]])) / drift.speed
    return drift if _USUAL[0] < usual < _USUAL[1] else None


def mend_drift(clip: Clip, low: np.ndarray) -> Clip:
    """The clip without the steady drift of its floor, which its lowest points `low (T)` m tell."""
    drift = find_drift(low, clip.fps)
    if drift is None:
        return clip
    return clip.replaced(root_pos=clip.root_pos - drift.heights()[:, None] * np.array([0.0, 0.0, 1.0]))


def drift_faults(low: np.ndarray, fps: float, flying: np.ndarray) -> list[Fault]:
    """The steady drift, or else the spells off the floor in which the body rises or sinks steadily.

    Args:
        low: `(T)` m, the body's lowest point. flying: `(T)`, where it falls freely.
    """
    drift = find_drift(low, fps)
    if drift is not None:
        way = "rises" if drift.speed > 0 else "sinks"
        told = f"the floor under its steps {way} steadily by {abs(drift.size_m) * 100:.0f} cm"
        return [Fault("float", "", 0, len(low) - 1, abs(drift.size_m) * 100, told)]
    out = []
    for first, last in find_runs((low > ALOFT_M) & ~flying, 0):
        if last - first + 1 < HELD_S * fps:
            continue
        part = low[first : last + 1]
        speed = float(np.median(np.diff(part))) * fps
        whole = float(part[-1] - part[0]) / (last - first) * fps
        if abs(speed) > RISES and whole * speed > 0 and 0.5 < abs(whole / speed) < 2.0:
            told = "it goes up or down there while something bears it"
            out.append(Fault("float", "", first, last, float(part.max()) * 100, told))
    return out
