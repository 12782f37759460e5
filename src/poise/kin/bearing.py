"""Limbs that bear, and the travel on which all of them agree.

A twist (v, w) lets points p that bear go with -(v + w z x p), see `kin.travel`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch

from poise.body import BodyTable
from poise.kin.feet.contact import NEAR_M
from poise.kin.solids import extreme_points

#: Limbs that may bear: a crawl's hands and knees count as feet do.
BEARS = ("foot", "hand", "shin")
#: A point bears up to this height (m) over the lowest of its frame, and leaves or lands where it rises
#: or falls faster than the first (m/s) and this share of its own speed.
WITH_M, RISE_SPEED, RISE_SHARE = 0.03, 0.2, 0.25
#: Soles that come to rest this much (m) higher than others have a floor of their own.
OWN_FLOOR_M = 0.015
#: Slowest travel (m/s) that is told from slides, and what a turn makes of points that bear (m/s, rms).
SLOWEST, SLOWEST_SPIN = 0.2, 0.08
#: Velocities this near to the travel's (m/s, and share of its speed) are steady.
STEADY, STEADY_SHARE = 0.12, 0.25
#: Share of their way that limbs go along the travel: all of them, and each.
ALONG, ALONG_EACH = 0.8, 0.6
#: Share of the bearing time in which a limb may stand still, slower than this share of the travel.
STANDS, STILL = 0.3, 0.3
#: The limb that bears second most does so for this share of the other's time, and goes as fast within
#: this ratio.
BOTH, ALIKE = 0.35, 2.0
#: Rounds in which limbs that skim the floor in their swing are told from those that bear.
ROUNDS = 8


class Bearing(NamedTuple):
    """What limbs do from frame to frame while they bear.

    weight: `(T - 1, L)`, how surely each bears, 0 to 1. velocity, place: `(T - 1, L, 3)` m/s and m, of
    its points that bear. spin: `(T - 1, L)` rad/s, of them about each other, seen from above. size:
    `(T - 1, L)` m^2, their mean squared distance from their middle.
    """

    weight: np.ndarray
    velocity: np.ndarray
    place: np.ndarray
    spin: np.ndarray
    size: np.ndarray

    @property
    def speed(self) -> np.ndarray:
        """`(T - 1, L)` m/s, rms of the points that bear."""
        flat = np.square(self.velocity[..., :2]).sum(-1)
        return np.sqrt(flat + self.size * self.spin**2)


class Fit(NamedTuple):
    """A travel fitted to what limbs do.

    twist: v_x, v_y m/s of a body at the centre, and w rad/s. going: `(T - 1, L, 2)` m/s, how it lets
    limbs go that bear, and size: `(T - 1, L)` m/s, rms of all their points. weight: `(T - 1, L)`, those
    that bear, at most 1 a frame. off: `(T - 1, L)`, how far each is from `going`, 1 where it is not
    steady. left: m/s, rms of what is not explained.
    """

    twist: np.ndarray
    going: np.ndarray
    size: np.ndarray
    weight: np.ndarray
    off: np.ndarray
    left: float


def bearing_of(table: BodyTable, pos: torch.Tensor, quat: torch.Tensor, fps: float) -> Bearing:
    """A point bears the more surely the lower it is: in its frame, and over the floor of the clip."""
    weights, velocities, places = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    spins, sizes = list[np.ndarray](), list[np.ndarray]()
    rows = [i for i, r in enumerate(table.rows) if r.kind in BEARS]
    limbs = [extreme_points(table, pos, quat, [i]).numpy() for i in rows]
    middles = [0.5 * (p[1:] + p[:-1]) for p in limbs]
    floors = [float(np.quantile(m[..., 2].min(-1), 0.05)) for m in middles]
    floor = min(floors, default=0.0)
    # Soles of a measured body differ by a centimetre or two; a limb that comes as low has its own.
    heights = [
        m[..., 2] - (own if own - floor < OWN_FLOOR_M else floor)
        for m, own in zip(middles, floors, strict=True)
    ]
    lows = np.min([h.min(-1) for h in heights], axis=0)
    for points, middle, z in zip(limbs, middles, heights, strict=True):
        u = np.diff(points, axis=0) * fps
        leaves = np.abs(u[..., 2]) > RISE_SPEED + RISE_SHARE * np.linalg.norm(u[..., :2], axis=-1)
        sure = np.clip(1 - z / NEAR_M, 0, 1) * np.clip(1 - (z - lows[:, None]) / WITH_M, 0, 1)
        sure[leaves] = 0.0
        share = (sure / np.maximum(sure.sum(-1, keepdims=True), 1e-9))[..., None]
        weights.append(sure.max(-1))
        velocity, place = (share * u).sum(1), (share * middle).sum(1)
        arm, du = (middle - place[:, None])[..., :2], (u - velocity[:, None])[..., :2]
        size = (share * arm**2).sum((1, 2))
        turned = (share[..., 0] * (arm[..., 0] * du[..., 1] - arm[..., 1] * du[..., 0])).sum(1)
        velocities.append(velocity)
        places.append(place)
        spins.append(turned / np.maximum(size, 1e-6))
        sizes.append(size)
    return Bearing(*(np.stack(x, 1) for x in (weights, velocities, places, spins, sizes)))


def fit_of(bearing: Bearing, centre: np.ndarray, turn: bool) -> Fit:
    """Robust least squares. In every frame the limb that agrees best bears, another where it agrees as
    well: feet that are led low over the floor in their swing look like feet that bear."""
    weight, u = _shared(bearing.weight), bearing.velocity
    twist = np.array([-weighted_median(u[..., k], weight) for k in range(2)] + [0.0])
    if turn:
        twist = solved(weight, bearing, centre, turn)
    for _ in range(ROUNDS):
        off = np.where(bearing.weight > 0, _off(twist, bearing, centre)[2], np.inf)
        bears = off <= np.maximum(off.min(1, keepdims=True), 1.0)
        weight = _shared(np.where(bears, bearing.weight, 0.0))
        twist = solved(weight / np.maximum(off, 1.0), bearing, centre, turn)
    going, size, off = _off(twist, bearing, centre)
    wide = STEADY + STEADY_SHARE * size
    left = math.sqrt(float((weight * (np.minimum(off, 2.0) * wide) ** 2).sum() / weight.sum()))
    return Fit(twist, going, size, weight, off, left)


def _off(
    twist: np.ndarray, bearing: Bearing, centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """See `Fit`: going, size and off of a twist."""
    arm = bearing.place[..., :2] - centre
    going = -np.stack((twist[0] - twist[2] * arm[..., 1], twist[1] + twist[2] * arm[..., 0]), -1)
    size = np.sqrt(np.square(going).sum(-1) + bearing.size * twist[2] ** 2)
    apart = np.square(bearing.velocity[..., :2] - going).sum(-1)
    # Feet pivot as they walk; only of a turn is it asked how they spin.
    spin = bearing.size * (bearing.spin + twist[2]) ** 2 if twist[2] else 0.0
    return going, size, np.sqrt(apart + spin) / (STEADY + STEADY_SHARE * size)


def _shared(weight: np.ndarray) -> np.ndarray:
    """Weights that sum to at most 1 in every frame."""
    return weight / np.maximum(weight.sum(1, keepdims=True), 1.0)


def weighted_median(values: np.ndarray, weight: np.ndarray) -> float:
    """The value with half of the weight on either side."""
    order = np.argsort(values, axis=None)
    total = np.cumsum(weight.ravel()[order])
    return float(values.ravel()[order][np.searchsorted(total, 0.5 * total[-1])])


def solved(weight: np.ndarray, bearing: Bearing, centre: np.ndarray, turn: bool) -> np.ndarray:
    """v_x, v_y, w that minimise sum weight |v + w z x arm + u|^2 of all points; without a turn w = 0."""
    w = (weight / max(float(weight.sum()), 1e-9))[..., None]
    u, arm = bearing.velocity[..., :2], bearing.place[..., :2] - centre
    mean_u, mean_arm, spin = (w * u).sum((0, 1)), (w * arm).sum((0, 1)), 0.0
    if turn:
        du, da = u - mean_u, arm - mean_arm
        own = w[..., 0] * bearing.size
        inertia = float((w * da**2).sum() + own.sum())
        spin = (w[..., 0] * (da[..., 0] * du[..., 1] - da[..., 1] * du[..., 0])).sum()
        spin = -float(spin + (own * bearing.spin).sum()) / max(inertia, 1e-9)
    return np.array([spin * mean_arm[1] - mean_u[0], -spin * mean_arm[0] - mean_u[1], spin])


def along_of(fit: Fit, bearing: Bearing) -> np.ndarray:
    """`(T - 1, L)` m/s, how fast what bears goes the way of the travel, times its weight."""
    way = (bearing.velocity[..., :2] * fit.going).sum(-1)
    way = way - bearing.size * bearing.spin * fit.twist[2]
    return fit.weight * way / np.maximum(fit.size, 1e-9)


def is_clear(fit: Fit, bearing: Bearing) -> bool:
    """Whether what bears goes along the travel, at least two limbs do, and none stands still."""
    along, speed, size = (
        along_of(fit, bearing),
        bearing.speed if fit.twist[2] else flat_speed(bearing),
        fit.size,
    )
    slowest = SLOWEST_SPIN if fit.twist[2] else SLOWEST
    if float((fit.weight * size).sum()) < slowest * float(fit.weight.sum()):
        return False
    way = fit.weight * speed
    stands = float(bearing.weight[speed < STILL * size].sum() / bearing.weight.sum())
    if along.sum() < ALONG * way.sum() or stands > STANDS:
        return False
    bears = fit.weight.sum(0)
    most = np.argsort(-bears)[:2]
    if len(most) < 2 or bears[most[1]] < BOTH * bears[most[0]]:
        return False
    each = [along[:, k].sum() / max((fit.weight * size)[:, k].sum(), 1e-9) for k in most]
    steady = all(along[:, k].sum() >= ALONG_EACH * way[:, k].sum() for k in most)
    return bool(steady and min(each) > 0 and max(each) <= ALIKE * min(each))


def flat_speed(bearing: Bearing) -> np.ndarray:
    """`(T - 1, L)` m/s of the middle of what bears."""
    return np.linalg.norm(bearing.velocity[..., :2], axis=-1)
