"""A motion estimated from a trembling one, and faults of capture that no body can do, repaired."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from poise.body import Anatomy, body_of, find_anatomy
from poise.errors import PoiseError
from poise.formats.point_noise import drop_spikes
from poise.kinematics.rate import judge_rate
from poise.kinematics.repair.faults import Fault
from poise.kinematics.repair.speeds import TRUNK_SPEED, SpeedRepair, limit_speeds, without_rougher
from poise.kinematics.repair.turns import Flip, out_of_reach, unflip
from poise.kinematics.travel import Travel, find_travel
from poise.motion import Clip, Skeleton
from poise.motion.clip import remembered
from poise.motion.rotations import (
    forward_kinematics,
    normalize,
    quat_between,
    quat_conj,
    quat_distance,
    quat_mul,
    quat_to_rotvec,
    rotvec_to_quat,
    unwrap_quats,
)
from poise.motion.smoothing import (
    LINES,
    NOTHING_MM,
    SHORTEST,
    WHITE_MM,
    Spectrum,
    faded,
    filled,
    find_runs,
    only_noise,
    pieces,
    smoothed,
    squared,
    tremble_of,
    white_mm,
)
from poise.motion.vectors import norm

#: A joint that stands still for so long (s) and leaps on by so many of its steps, by this angle (rad) at
#: least, was held.
HELD_S, LEAPS, LEAP_RAD = 0.08, 3.0, 0.03
#: How far a spike turns its joint (rad) and moves the end of what hangs on it (m) at least: ankles and
#: toes snap by nearly as much in kicks and dashes.
SPIKE_RAD, SPIKE_M = 0.35, 0.06
#: Without a spike the places of what hangs on its joint are smoother by this factor at least.
CALMER = 0.7
#: Smaller spikes are told as well if this share of all joints and frames leaps for certain: so many
#: times the usual roughness, this angle (rad) at least, in so many rounds. Where less leaps, but all
#: trembles, by this angle.
MANY_SPIKES, SMALL_TIMES, SMALL_RAD, SPIKE_ROUNDS = 1e-3, 5.0, 0.02, 3
FEW_RAD = 0.1
#: A tremble is looked for in what is faster than this (Hz), of axes that turn by more than this (rad).
SLOW_HZ, STILL_RAD = 0.7, 1e-5
#: Turns (rad) of the middle joint from each frame to the next that leave nothing of a motion: random
#: ones are 2.2 on average.
NOTHING_RAD = 1.3
#: Cycles are the same where they are apart by less than this share of their energy.
REPEATED = 1e-4


Lost = tuple[str, int, int, int]
"""Kind, joint, first and last frame, see `find_lost`."""


def refill(clip: Clip, found: Sequence[Lost] | None = None) -> Clip:
    """The clip with every joint that was lost on the smoothest curve through its other frames; one that
    lost none comes back as it is. found: what `find_lost` says, which is asked where it is not given."""
    rot = _continuous(clip.rot)
    found = find_lost(clip, rot) if found is None else found
    return clip if not found else clip.replaced(rot=_filled(rot, found, clip.fps))


def _filled(rot: np.ndarray, found: Sequence[Lost], fps: float) -> np.ndarray:
    """Rotations `(T, J, 4)` with those that were lost on the smoothest curve through the others."""
    rot, lost = rot.copy(), np.zeros(rot.shape[:2], dtype=bool)
    for _, j, a, b in found:
        lost[a : b + 1, j] = True
    if len(at := np.flatnonzero(lost.any(0))):
        rot[:, at] = _refilled(rot, lost, at, fps)
    return rot / np.linalg.norm(rot, axis=-1, keepdims=True)


def _refilled(rot: np.ndarray, lost: np.ndarray, joints: np.ndarray, fps: float) -> np.ndarray:
    """`(T, N, 4)` the rotations of N joints, `filled` where they were `lost (T, J)`."""
    tracks = filled(rot[:, joints].swapaxes(0, 1), ~lost[:, joints].T, fps)
    return tracks.swapaxes(0, 1)


def denoise(clip: Clip) -> Clip:
    """The clip without the noise that it has; one that does not tremble comes back as it is.

    A long clip is told and smoothed by pieces of `PIECE_S`, which fade into each other.
    """
    root, rot = np.array(clip.root_pos), unwrap_quats(clip.rot)
    positions, world = clip.positions(), unwrap_quats(clip.world()[1])
    out_root, out_rot, changed = root.copy(), rot.copy(), False
    for here in pieces(clip.frames, clip.fps):
        if (white := white_mm(positions[here], clip.fps)) > NOTHING_MM:
            raise only_noise(clip.name, here, f"{white / 1e3:.2g} m")
        found = _piece(clip, root[here], rot[here], world[here], positions[here])
        if found is None:
            continue
        changed = True
        share = faded(here, clip.frames, clip.fps)
        out_root[here] += share[:, None] * (found[0] - root[here])
        turn = quat_to_rotvec(quat_mul(quat_conj(rot[here]), found[1]))
        step = rotvec_to_quat(share[:, None, None] * turn)
        out_rot[here] = quat_mul(out_rot[here], step)
    if not changed:
        return clip
    out_rot /= np.linalg.norm(out_rot, axis=-1, keepdims=True)
    return clip.replaced(root_pos=out_root, rot=unwrap_quats(out_rot))


def _turn(rot: np.ndarray) -> float:
    """How far (rad) joints turn from one frame to the next: the mean over frames of the middle joint, of
    those that turn."""
    if len(rot) < SHORTEST:
        return 0.0
    step = quat_distance(rot[1:], rot[:-1]).mean(0)
    return float(np.median(step[step > STILL_RAD])) if (step > STILL_RAD).any() else 0.0


@remembered
def noise_faults(clip: Clip) -> tuple[tuple[Fault, ...], Clip]:
    """The faults that noise is, and the clip with its lost joints filled in.

    A tremble of the body counts in mm (rms over joints), the largest of any piece; spikes and held
    joints count in degrees.
    """
    if clip.frames < SHORTEST:
        return (), clip
    rot = _continuous(clip.rot)
    for here in pieces(clip.frames, clip.fps):
        if (turn := _turn(rot[here])) > NOTHING_RAD:
            raise only_noise(clip.name, here, f"{np.degrees(turn):.0f} degrees")
    # Trembling keypoints lost their spikes as points. Bones that were fitted to them turn about each
    # other, and one alone that is filled in would move what it carries.
    fitted = any(kind == "tremble" for kind, *_ in clip.skeleton.source.mended)
    lost = [] if fitted else find_lost(clip, rot)
    whole = refill(clip, lost)
    trembles = _trembles(whole)
    if trembles and not fitted:
        lost = find_lost(clip, rot, noisy=True)
        whole = refill(clip, lost)
        trembles = _trembles(whole)
    turned = np.degrees(quat_distance(whole.rot, clip.rot))
    out = [
        Fault(kind, clip.skeleton.names[j], a, b, float(turned[a : b + 1, j].max()))
        for kind, j, a, b in lost
    ]
    if trembles:
        worst = max(trembles, key=lambda f: f.size)
        out.append(replace(worst, start=trembles[0].start, stop=trembles[-1].stop))
    return tuple(out), whole


def _trembles(clip: Clip) -> list[Fault]:
    """The tremble of every piece of a clip without lost joints that has one."""
    positions, calm = clip.positions(), unwrap_quats(clip.rot)
    groups, out = np.repeat(np.arange(len(clip.skeleton)), 3), list[Fault]()
    for here in pieces(clip.frames, clip.fps):
        first, last, places = here.start, here.stop - 1, positions[here]
        hz = _tremble_hz(calm[here], clip.fps)
        if hz is not None:
            found = Spectrum.of(places.reshape(len(places), -1), clip.fps, groups)
            size = 1e3 * math.sqrt(float(found.tone(hz)[0].mean()))
            out.append(Fault.tremble(first, last, size, hz))
        elif (white := white_mm(places, clip.fps)) >= WHITE_MM:
            out.append(Fault.tremble(first, last, white, None))
    return out


def _piece(
    clip: Clip, root: np.ndarray, rot: np.ndarray, world: np.ndarray, positions: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Root `(T, 3)` and rotations `(T, J, 4)` of a piece without its noise, None where it has none."""
    tones, calm_root, calm = [], root, {"own": rot, "world": world}
    if len(root) < SHORTEST:
        return None
    for _ in range(LINES):
        hz = _tremble_hz(calm["own"], clip.fps)
        if hz is None:
            break
        tones.append(hz)
        axes = np.arange(3)
        found = Spectrum.of(calm_root, clip.fps, axes)
        calm_root = calm_root - tremble_of(calm_root, axes, found, hz)[0]
        calm = {frame: _still(quats, clip.fps, hz) for frame, quats in calm.items()}
    if not tones and white_mm(positions, clip.fps) < WHITE_MM:
        return None
    # In a captured chain the noise of one joint undoes that of the next: it is the world's then.
    floors = {f: _pose_spectrum(calm_root, q, clip.fps).floor()[1:-1].sum() for f, q in calm.items()}
    taken = {f: ((calm[f] - q) ** 2).sum() for f, q in (("own", rot), ("world", world))}
    frames, joints = rot.shape[:2]
    own = floors["own"] * frames + taken["own"] <= floors["world"] * frames + taken["world"]
    quats = calm["own" if own else "world"]
    y = np.concatenate((quats.reshape(frames, -1), calm_root), 1)
    groups = _groups(joints)
    # Smoothing is for white noise; a motion that a tremble alone shook is still without it.
    if not tones or _white_of(clip, calm_root, calm["own"]) >= WHITE_MM:
        y = smoothed(y, clip.fps, groups, Spectrum.of(y, clip.fps, groups).floor())
    out = normalize(y[:, : 4 * joints].reshape(quats.shape))
    if not own:
        local = [out[:, 0]]
        local += [quat_between(out[:, p], out[:, j]) for j, p in enumerate(clip.skeleton.parents) if j]
        out = np.stack(local, 1)
    return y[:, 4 * joints :], out


def _white_of(clip: Clip, root: np.ndarray, rot: np.ndarray) -> float:
    """White noise (mm) of a piece of a clip in another motion, see `white_mm`."""
    unit = rot / np.linalg.norm(rot, axis=-1, keepdims=True)
    return white_mm(
        forward_kinematics(clip.skeleton.parents, clip.skeleton.offsets, root, unit)[0], clip.fps
    )


def find_lost(clip: Clip, rot: np.ndarray, noisy: bool = False) -> list[Lost]:
    """(kind, joint, first, last frame) where joints were not seen as they were.

    A "spike" lasts a frame or two and turns the joint by `SPIKE_RAD` or more; a joint is "held" that
    stands still and then leaps to where it has got. A spike that the next joints undo is none: what
    hangs on it would leap without. rot: `(T, J, 4)`, continuous in sign. noisy: smaller spikes are
    looked for as well, as they are wherever large ones are many.
    """
    spikes, lever = drop_spikes(rot, clip.fps)[1], _reach(clip.skeleton)
    sure = np.zeros_like(spikes)
    joints = np.flatnonzero(spikes.any(0))
    back = _refilled(rot, spikes, joints, clip.fps)
    for k, j in enumerate(joints):
        turned = 2.0 * np.linalg.norm(back[:, k] - rot[:, j], axis=-1)
        least = max(SPIKE_RAD, SPIKE_M / max(lever[j], 1e-3))
        for a, b in find_runs(spikes[:, j], 0):
            sure[a : b + 1, j] = turned[a : b + 1].max() >= least
    out = _leaping(clip, rot, sure)
    many = sum(b - a + 1 for _, _, a, b in out) >= MANY_SPIKES * sure.size
    if noisy or many:
        sure[:] = False
        for _, j, a, b in out:
            sure[a : b + 1, j] = True
        # Where leaps are few, only what carries other joints can be told from noise.
        carries = np.isin(np.arange(rot.shape[1]), clip.skeleton.parents) | many
        least = SMALL_RAD if many else FEW_RAD
        out = _leaping(clip, rot, sure | (_small_spikes(rot, sure, clip.fps, least) & carries))
    still = (rot[1:] == rot[:-1]).all(-1)
    step, reach = np.linalg.norm(np.diff(rot, axis=0), axis=-1), max(3, round(0.2 * clip.fps))
    for j in np.flatnonzero(still.any(0) & ~still.all(0)):
        for first, last in find_runs(still[:, j], 0):
            if (last - first + 1) < HELD_S * clip.fps or last + 1 >= len(step):
                continue
            near = np.concatenate((step[max(first - reach, 0) : first, j], step[last + 2 :, j][:reach]))
            near = near[near > 0]
            if len(near) and step[last + 1, j] > max(LEAPS * np.median(near), 0.5 * LEAP_RAD):
                out.append(("held", int(j), first + 1, last + 1))
    return out


def _leaping(clip: Clip, rot: np.ndarray, found: np.ndarray) -> list[Lost]:
    """The spikes `found (T, J)` without which what hangs on their joints moves more smoothly, by fourth
    differences. At an end a leap is in those once, while noise is in them sqrt(70) times: there second
    differences tell.

    Joints fitted to keypoints twist to and fro, a forearm back as far as its upper arm: no hand leaps.
    """
    spikes: list[Lost] = [
        ("spike", int(j), a, b)
        for j in np.flatnonzero(found.any(0))
        for a, b in find_runs(found[:, j], 0)
    ]
    if not spikes:
        return spikes
    skeleton = clip.skeleton
    hang = np.eye(len(skeleton), dtype=bool)
    for j in range(len(skeleton) - 1, 0, -1):
        hang[skeleton.parents[j]] |= hang[j]
    np.fill_diagonal(hang, False)
    before, last = clip.positions(), clip.frames - 1
    rough = [_rough(before, n) for n in (4, 2)]
    while spikes:
        after = clip.replaced(rot=_filled(rot, spikes, clip.fps)).positions()
        both = [(was, _rough(after, n)) for was, n in zip(rough, (4, 2), strict=True)]
        kept = []
        for one in spikes:
            _, j, a, b = one
            end = a <= 2 or b >= last - 2
            near = slice(max(a - (2 if end else 4), 0), b + 1)
            there = [x[near, hang[j]].max(initial=0.0) for x in both[int(end)]]
            kept += [one] if there[1] <= CALMER * there[0] else []
        if len(kept) == len(spikes):
            break
        spikes = kept
    return spikes


def _rough(places: np.ndarray, n: int) -> np.ndarray:
    """`(T - n, J)` m, differences of an order of joints' places `(T, J, 3)`."""
    return norm(np.diff(places, n=n, axis=0))


def _continuous(rot: np.ndarray) -> np.ndarray:
    """Rotations `(T, J, 4)` continuous in sign; a frame that leaps by a half turn does not exchange the
    sign of those after it, as it may in `unwrap_quats`."""
    out, alike = np.array(rot), np.zeros(rot.shape[:2])
    for k in (1, 2, 3):
        alike[k:] += (rot[k:] * rot[:-k]).sum(-1)
    # Most joints never leave the hemisphere of the three frames before.
    leaves = np.flatnonzero((alike < 0).any(0))
    loose = out[:, leaves]
    for t in range(1, len(out) if len(leaves) else 0):
        away = (loose[max(0, t - 3) : t] * loose[t]).sum((0, -1)) < 0
        loose[t, away] *= -1.0
    out[:, leaves] = loose
    return out


def _small_spikes(rot: np.ndarray, known: np.ndarray, fps: float, least: float) -> np.ndarray:
    """`(T, J)` bool, spikes of a frame that are too small to be sure of in a motion without larger ones.

    A frame that leaps alone by s leaves fourth differences s (1, -4, 6, -4, 1): it stands out of the
    second around it, and its neighbours point the other way. known: `(T, J)`, the larger ones.
    """
    from scipy.ndimage import median_filter

    found, reach = known.copy(), 2 * max(2, round(0.5 * fps)) + 1
    for _ in range(SPIKE_ROUNDS):
        calm = _refilled(rot, found, np.arange(rot.shape[1]), fps)
        rough = np.zeros_like(calm)
        rough[2:-2] = np.diff(calm, n=4, axis=0) / 6.0
        size = np.linalg.norm(rough, axis=-1)
        usual = median_filter(size, (reach, 1), mode="nearest")
        beside = np.stack([(rough[2:-2] * rough[2 + k : len(rough) - 2 + k]).sum(-1) for k in (-1, 1)])
        tall = (size[2:-2] > np.maximum(SMALL_TIMES * usual[2:-2], 0.5 * least)) & (beside < 0).all(0)
        peak = np.stack([size[2 + k : len(size) - 2 + k] for k in (-2, -1, 0, 1, 2)]).argmax(0) == 2
        fresh = np.zeros_like(found)
        fresh[2:-2] = tall & peak
        if not (fresh & ~found).any():
            break
        found |= fresh
    for j in range(rot.shape[1]):
        for way in (1, -1):
            found[::way, j][:3] |= _spikes_at_start(rot[::way, j], found[::way, j], fps, least)
    return found


def _spikes_at_start(y: np.ndarray, known: np.ndarray, fps: float, least: float) -> np.ndarray:
    """`(3)` bool, which of the first three frames of `y (T, 4)` must leap for the rest to be smooth: as
    few as can be, those without which it is smoothest."""
    for many in range(3):
        tries = list[tuple[float, np.ndarray]]()
        for leaps in combinations(range(3), many):
            seen = known.copy()
            seen[list(leaps)] = True
            rough = np.linalg.norm(np.diff(filled(y, ~seen, fps), n=3, axis=0), axis=-1)
            over = rough[:4].max() / max(SMALL_TIMES * np.median(rough[:60]), least)
            tries.append((over, np.isin(np.arange(3), leaps)))
        over, found = min(tries, key=lambda one: one[0])
        if over <= 1.0:
            return found
    return np.zeros(3, dtype=bool)


def _reach(skeleton: Skeleton) -> np.ndarray:
    """`(J)` m, how far the farthest tip hangs from each joint along its bones."""
    out, length = np.zeros(len(skeleton)), np.linalg.norm(skeleton.offsets, axis=-1)
    for j, tip in skeleton.tips:
        out[j] = max(out[j], float(np.linalg.norm(tip)))
    for j in range(len(skeleton) - 1, 0, -1):
        parent = skeleton.parents[j]
        out[parent] = max(out[parent], out[j] + length[j])
    return out


def _groups(joints: int) -> np.ndarray:
    return np.concatenate((np.repeat(np.arange(joints), 4), [joints] * 3))


def _pose_spectrum(root: np.ndarray, rot: np.ndarray, fps: float) -> Spectrum:
    y = np.concatenate((rot.reshape(len(rot), -1), root), 1)
    return Spectrum.of(y, fps, _groups(rot.shape[1]))


def _tremble_hz(rot: np.ndarray, fps: float) -> float | None:
    """The frequency (Hz) of the clearest tremble of rotations `(T, J, 4)`; None without any, and of
    cycles that repeat each other exactly, as those of a loop: noise never comes back."""
    turn = _turns(rot, fps, SLOW_HZ).reshape(len(rot), -1)
    turn = turn[:, np.abs(turn).max(0) > STILL_RAD]
    if not turn.shape[1] or _repeats(rot.reshape(len(rot), -1)):
        return None
    return Spectrum.of(turn, fps, np.zeros(turn.shape[1], dtype=int)).tremble()


def _repeats(y: np.ndarray) -> bool:
    """Whether `y (T, C)` is one cycle again and again."""
    frames, y = len(y), y - y.mean(0)
    # |y_t - y_t+P|^2 summed over t, of all P at once.
    power = squared(np.fft.rfft(y, 2 * frames, axis=0)).sum(1)
    shared = np.fft.irfft(power)[: frames // 2 + 1]
    square = np.concatenate(([0.0], np.cumsum((y**2).sum(1))))
    lag = np.arange(3, frames // 2 + 1)
    apart = square[frames - lag] + square[-1] - square[lag] - 2 * shared[lag]
    return bool(len(lag) and (apart < REPEATED * square[-1]).any())


def _turns(rot: np.ndarray, fps: float, hz: float) -> np.ndarray:
    """`(T, J, 3)` rad, the small turns from the motion below `hz` to `rot (T, J, 4)`, in their axes."""
    return quat_to_rotvec(quat_mul(quat_conj(_slow(rot, fps, hz)), rot))


def _slow(rot: np.ndarray, fps: float, hz: float) -> np.ndarray:
    """`(T, J, 4)` the motion of rotations below a frequency: that of a smoothing spline by its gain,
    turned about its ends. Its bands would need SciPy, for which clean clips need not wait."""
    flat = rot.reshape(len(rot), -1)
    line = flat[0] + np.linspace(0.0, 1.0, len(rot))[:, None] * (flat[-1] - flat[0])
    both = np.concatenate((flat - line, -(flat - line)[-2:0:-1]))
    wave = 2 * np.sin(np.pi * np.arange(len(both) // 2 + 1) / len(both))
    gain = 1.0 / (1.0 + (wave / (2 * np.sin(np.pi * hz / fps))) ** 6)
    slow = line + np.fft.irfft(gain[:, None] * np.fft.rfft(both, axis=0), len(both), axis=0)[: len(rot)]
    return normalize(slow.reshape(rot.shape))


def _still(rot: np.ndarray, fps: float, hz: float) -> np.ndarray:
    """The rotations `(T, J, 4)` without a tremble at `hz`.

    A joint trembles about axes of its own or of its parent, where its tremble is pure; in the components
    of a quaternion the joint's turning modulates it. So it is taken off the small turn between a slow
    motion and the joint, in the frame in which the tone stands out most.
    """
    frames, joints = rot.shape[:2]
    base, quat = _slow(rot, fps, hz / 3), rot
    groups = np.repeat(np.arange(joints), 3)
    ways = (
        (lambda x: quat_mul(quat_conj(base), x), lambda d: quat_mul(base, d)),
        (lambda x: quat_mul(x, quat_conj(base)), lambda d: quat_mul(d, base)),
    )
    tries = []
    for apart, together in ways:
        turn = quat_to_rotvec(apart(quat)).reshape(frames, -1)
        found, clear = tremble_of(turn, groups, Spectrum.of(turn, fps, groups), hz)
        left = (turn - found).reshape(frames, joints, 3)
        tries.append((clear, together(rotvec_to_quat(left))))
    own = tries[0][0] >= tries[1][0]
    return unwrap_quats(np.where(own[:, None], tries[0][1], tries[1][1]))


@dataclass(frozen=True)
class CleanReport:
    """What was repaired in one clip; empty for a clean one. Frames are the file's.

    flips: feet and hands that were turned back. speeds: turns faster than a human joint. left: (joint,
    frames) of feet and hands that are still where none reaches, since no repair was sure enough. kept:
    turns too fast that stay, since the body would jerk more without, see `without_rougher`. noise: what
    was taken off, and joints that were lost (`estimate.noise_faults`).
    """

    flips: tuple[Flip, ...] = ()
    speeds: tuple[SpeedRepair, ...] = ()
    left: tuple[tuple[str, int], ...] = ()
    kept: tuple[SpeedRepair, ...] = ()
    noise: tuple[Fault, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.flips or self.speeds or self.left or self.kept or self.noise)

    def then(self, later: CleanReport) -> CleanReport:
        """The repairs of a clip that was repaired once more: both, and what is left after that."""
        both = self.flips + later.flips, self.speeds + later.speeds
        return CleanReport(*both, later.left, later.kept, self.noise + later.noise)

    def sentences(self) -> list[str]:
        """The repairs in words, one line for each kind."""
        out = self.noise_sentences()
        if self.flips:
            parts = [
                f"{joint} {_frames(mine)} (by up to {max(f.angle_deg for f in mine):.0f} degrees)"
                for joint, mine in _by_joint(self.flips)
            ]
            out.append(f"Turned back from where no joint reaches: {', '.join(parts)}.")
        if self.speeds:
            groups = sorted(_by_joint(self.speeds), key=lambda g: -max(s.before for s in g[1]))
            parts = []
            for joint, mine in groups[:4]:
                before, after = max(s.before for s in mine), max(s.after for s in mine)
                parts.append(f"{joint} {_frames(mine)} ({before:.0f} rad/s, now {after:.0f})")
            more = f" and {len(groups) - 4} more joints" if len(groups) > 4 else ""
            out.append(f"Faster than a human joint, so interpolated: {', '.join(parts)}{more}.")
        if self.left:
            parts = [f"{joint} in {frames} frames" for joint, frames in self.left]
            out.append(f"Left where no joint reaches: {', '.join(parts)}.")
        if self.kept:
            told = ", ".join(f"{joint} {_frames(mine)}" for joint, mine in _by_joint(self.kept))
            out.append(f"Left faster than a human joint, since mending jerks the body more: {told}.")
        return out

    def noise_sentences(self) -> list[str]:
        """The noise that was taken off and the joints that were filled in, in words."""
        out = [
            f"The motion trembles by {f.size:.0f} mm {f.detail}: the tremble is taken off."
            for f in self.noise
            if f.kind == "tremble"
        ]
        lost = [f for f in self.noise if f.kind != "tremble"]
        if lost:
            parts = [f"{joint} {_frames(mine)}" for joint, mine in _by_joint(lost)]
            more = f" and {len(parts) - 4} more joints" if len(parts) > 4 else ""
            told = ", ".join(parts[:4])
            out.append(f"Joints that were lost for a moment are interpolated: {told}{more}.")
        return out

    def to_dict(self) -> dict[str, Any]:
        """The repairs as plain lists and numbers."""
        return asdict(self)


def _by_joint(found: Sequence[Any]) -> list[tuple[str, list[Any]]]:
    return [(j, [f for f in found if f.joint == j]) for j in dict.fromkeys(f.joint for f in found)]


def _frames(found: Sequence[Any]) -> str:
    count = sum(f.stop - f.start + 1 for f in found)
    return f"{count} frame{'' if count == 1 else 's'}"


def clean_clip(
    clip: Clip, anatomy: Anatomy | None = None, rougher: bool = True, raw: bool | None = None
) -> tuple[Clip, CleanReport]:
    """The clip with its faults repaired, and every repair; a clean clip comes back as it is.

    First joints that were lost for a moment are filled in (`refill`), then feet and hands are turned
    back (`unflip`), speeds that no human joint reaches are interpolated (`limit_speeds`), so that what
    remains of the jumps goes too, and at last noise is taken off (`denoise`).

    rougher: also where that jerks the body more, see `without_rougher`. A body with joints that cannot
    turn so fast wants it; a file that stays a file does not. raw: joints stay lost and noise stays, by
    default where the clip's source says so.
    """
    anatomy = anatomy or find_anatomy(clip.skeleton, [clip])
    raw = clip.skeleton.source.raw if raw is None else raw
    found, whole = ((), clip) if raw else noise_faults(clip)
    turned, flips = unflip(whole, anatomy, TRUNK_SPEED)
    slowed, speeds = limit_speeds(turned, anatomy)
    kept: tuple[SpeedRepair, ...] = ()
    if not rougher:
        slowed, speeds, kept = without_rougher(turned, slowed, speeds)
    if any(f.kind == "tremble" for f in found):
        slowed = denoise(slowed)
    return slowed, CleanReport(flips, speeds, out_of_reach(slowed, anatomy), kept, found)


@dataclass(frozen=True)
class Faults:
    """What a clip's fit will repair or doubt: in words, and as numbers (`CleanReport.to_dict` and
    `likely_fps`, the frame rate that physics vouches for where it is far from the file's); and what was
    taken out of a clip in place."""

    sentences: tuple[str, ...]
    numbers: dict[str, Any]
    travel: Travel | None = None


def find_faults(clip: Clip) -> Faults | None:
    """The faults of a clip, before a body is fitted; None where its joints are no human's."""
    try:
        _, report = clean_clip(clip)
        table, judged = body_of(clip), judge_rate(clip)
    except PoiseError:
        return None
    doubt = judged.sentence()
    numbers = {**report.to_dict(), "likely_fps": judged.likely}
    return Faults((*([doubt] if doubt else []), *report.sentences()), numbers, find_travel(clip, table))
