"""Dirt of known size on streams, and what live's causal filter leaves of it beside the one-euro filter.

    python benchmarks/repair.py --data FOLDER --live -o results/repair_live.csv

Clips are played as `poise live` plays them, again and again, for 10 s; the first 3 s, in which noise is
measured, do not count. The one-euro filter has the setting that an oracle chooses for the clip, one for
rotations and one for the root. Distance is to the truth of the moment that a pose is for: the moment it
is given, or for `live` the frame before, which is the delay that it states; `newest` is its estimate
without that delay, and `one-euro late` has the setting that is best for the frame before. Delay is the
shift at which a stream is nearest to the truth, and `aligned_mm` the distance there.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from repair import KINDS, dirty
from repair_rivals import one_euro

from poise.kinematics.stream_noise import of_points
from poise.live.people import Steady
from poise.live.sources import Loop
from poise.motion import Clip

KINDS_LIVE, SIZES_MM, CLIPS = ("white", "tone5"), (10.0, 25.0, 50.0), 10
LONG_S, SKIP_S, REACH = 10.0, 3.0, 10
#: Streams that are a frame late.
LATE = ("live", "one-euro late")
#: Settings of the one-euro filter: Hz, and by how much faster channels raise it.
SETTINGS = tuple(product((0.5, 1.0, 2.0, 4.0, 8.0, 12.0), (0.0, 0.5, 2.0, 8.0, 32.0)))
Pose = tuple[np.ndarray, np.ndarray]


def played(clip: Clip) -> Clip:
    """The clip as a stream plays it."""
    loop = Loop(clip)
    root, rot = zip(*(loop(k) for k in range(round(LONG_S * clip.fps))), strict=True)
    return clip.replaced(root_pos=np.stack(root), rot=np.stack(rot))


def off_mm(here: np.ndarray, truth: np.ndarray, late: int, fps: float) -> float:
    """mm between places `(T, K, 3)` and those `late` frames before them, on average."""
    first, end = round(SKIP_S * fps), len(truth) - 1
    apart = here[first:end] - truth[first - late : end - late]
    return 1e3 * float(np.linalg.norm(apart, axis=-1).mean())


def measured(here: np.ndarray, truth: np.ndarray, late: int, fps: float) -> dict[str, float]:
    """Distance, delay and the distance without it."""
    at = np.array([off_mm(here, truth, k, fps) for k in range(-1, REACH)])
    k, shift = int(at.argmin()), 0.0
    if 0 < k < REACH:
        left, mid, right = at[k - 1 : k + 2] ** 2
        shift = 0.5 * (left - right) / (left - 2 * mid + right)
    return {
        "distance_mm": float(at[late + 1]),
        "delay_ms": 1e3 * (k - 1 + shift) / fps,
        "aligned_mm": float(at[k]),
    }


def rotations(truth: Clip, kind: str, mm: float, seed: int) -> dict[str, np.ndarray]:
    """Places of joints of the dirty rotations, and of what filters make of them."""
    broken, fps = dirty(truth, kind, mm, seed), truth.fps
    rot, root = np.array(broken.rot), np.array(broken.root_pos)

    def turned(x: np.ndarray) -> Clip:
        x = x.reshape(rot.shape)
        return truth.replaced(rot=x / np.linalg.norm(x, axis=-1, keepdims=True))

    there = truth.positions()
    flat = rot.reshape(len(rot), -1)
    turns = [turned(one_euro(flat, fps, *s)) for s in SETTINGS]
    euro = dict[int, np.ndarray]()
    for late in (0, 1):
        by_rot = min(turns, key=lambda c: off_mm(c.positions(), there, late, fps))
        by_root = min(
            (one_euro(root, fps, *s) for s in SETTINGS),
            key=lambda x: off_mm(x[:, None], truth.root_pos[:, None], late, fps),
        )
        euro[late] = by_rot.replaced(root_pos=by_root).positions()
    steady, newest, later = Steady(truth.skeleton), list[Pose](), list[Pose]()
    for t in range(len(rot)):
        newest.append(steady(t / fps, root[t], rot[t]) or (root[t], rot[t]))
        before = steady.before()
        later.append(before[0][1:] if before else (root[max(t - 1, 0)], rot[max(t - 1, 0)]))

    def places(poses: list[Pose]) -> np.ndarray:
        at, turn = zip(*poses, strict=True)
        return truth.replaced(root_pos=np.stack(at), rot=np.stack(turn)).positions()

    return {
        "null": broken.positions(),
        "one-euro": euro[0],
        "one-euro late": euro[1],
        "newest": places(newest),
        "live": places(later),
    }


def keypoints(truth: Clip, kind: str, mm: float, seed: int) -> dict[str, np.ndarray]:
    """Dirty places of joints as an estimator tells them, and what filters make of them."""
    rng, there, fps = np.random.default_rng(seed), truth.positions(), truth.fps
    # The turns of a kind, as moves: every axis of every joint by itself.
    move = KINDS[kind](rng, truth)[0]
    move *= 1e-3 * mm / np.linalg.norm(move, axis=-1).mean()
    broken = there + move
    flat = broken.reshape(len(broken), -1)
    tries = [one_euro(flat, fps, *s).reshape(there.shape) for s in SETTINGS]
    euro = [min(tries, key=lambda x: off_mm(x, there, late, fps)) for late in (0, 1)]
    fading, newest, late = of_points(there.shape[1]), list[np.ndarray](), list[np.ndarray]()
    for t, z in enumerate(flat):
        newest.append(fading(z, 1.0 / fps))
        before = fading.before()
        late.append(before[0] if before else flat[max(t - 1, 0)])
    return {
        "null": broken,
        "one-euro": euro[0],
        "one-euro late": euro[1],
        "newest": np.stack(newest).reshape(there.shape),
        "live": np.stack(late).reshape(there.shape),
    }


def live_rows(clips: list[Clip], sizes: tuple[float, ...]) -> Iterator[tuple[str, str, list[float]]]:
    """(subject, metric, values by clip)."""
    streams = [played(clip) for clip in clips]
    for name, make in (("rotations", rotations), ("keypoints", keypoints)):
        for kind, mm in product(KINDS_LIVE, sizes):
            found = dict[str, list[float]]()
            for k, truth in enumerate(streams):
                there, fps = truth.positions(), truth.fps
                for which, here in make(truth, kind, mm, k).items():
                    for metric, value in measured(here, there, int(which in LATE), fps).items():
                        found.setdefault(f"{which}: {metric}", []).append(value)
            for ours, theirs in (
                ("live", "one-euro"),
                ("live", "one-euro late"),
                ("newest", "one-euro"),
            ):
                pairs = zip(found[f"{ours}: distance_mm"], found[f"{theirs}: distance_mm"], strict=True)
                found[f"{ours}: distance over {theirs}'s"] = [a / b for a, b in pairs]
            for metric, values in found.items():
                yield f"{name}, {kind} {mm:g} mm", metric, values
