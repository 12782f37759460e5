"""Frames of body parts from joint positions (Eqs. 6 to 24 of Skeleton2Humanoid), and their repair."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np

from poise.kinematics.coords import best_path, euler_path, through_lock, wrapped
from poise.kinematics.ik_bodies import IkBody, bend_normals, frame_of, held_normals, square_to
from poise.motion.rotations import best_rotation, normalize
from poise.motion.vectors import cross, norm
from poise.settings import Checked, Positive, Range

#: Every correction with what is wrong in the paper. Two more need no switch: the doubled symbols in the
#: denominators of Eqs. 11 and 12 are misprints of norms, and elbows bend to -z on the left and +z on the
#: right (Eqs. 10 and 13), so that ranges must be mirrored, which generated humanoids do.
CORRECTIONS: dict[str, str] = {
    "knee_subscripts": "Eq. 20 builds the left knee's parent from the child's axes; Eq. 23 does not",
    "square_ankle": "Eqs. 21, 24: shin and foot are not square, so Eq. 6 reads 30 degrees as 26.6",
    "hold_bend": "Eqs. 5, 10, 13, 20, 23: a straight limb has no bend axis, and beyond it flips",
    "spine_twist": "Eqs. 16-18: a straight spine has no bend axis, and it flips with the bend",
    "trunk_fit": "Eqs. 16, 18: cross products that vanish or point elsewhere on other skeletons",
    "thigh_twist": "Eqs. 19, 22: twist from the line of the hips leaves the thigh's to the knee",
    "branches": "Eq. 7 adds one turn once, and keeps flips between the two Euler branches",
}


@dataclass(frozen=True)
class IkConfig(Checked):
    """How the paper's equations are read.

    faithful: "corrected" or "paper"; what every correction below (see `CORRECTIONS`) takes that is None.
    straight: rad, the bend of a limb below which its bend plane is held. hold_frames: over how long.
    """

    faithful: Literal["corrected", "paper"] = "corrected"
    knee_subscripts: bool | None = None
    square_ankle: bool | None = None
    hold_bend: bool | None = None
    spine_twist: bool | None = None
    trunk_fit: bool | None = None
    thigh_twist: bool | None = None
    branches: bool | None = None
    straight: Annotated[float, Range(0, math.pi / 2, above=True, below=True)] = math.radians(3.0)
    hold_frames: Positive = 5.0

    def on(self, correction: str) -> bool:
        """Whether one of `CORRECTIONS` is made."""
        chosen = getattr(self, correction)
        return self.faithful == "corrected" if chosen is None else chosen

    @property
    def square(self) -> bool:
        """Whether all frames are square, so that Eq. 6 changes nothing."""
        return all(self.on(c) for c in CORRECTIONS if c != "branches")


class BodyFrames:
    """World frames `(T, 3, 3)` of rows from the positions `p (T, P, 3)` of one motion.

    l_ab is the vector from joint a to joint b. Of a standing body +x is left, +y up and +z forward.

    frames: row -> its frame, columns x, y, z; square except where an error of the paper is kept.
    knee_parent: rows of shins for which the paper states the parent's frame otherwise (Eq. 20).
    """

    def __init__(self, p: np.ndarray, body: IkBody, config: IkConfig, at_rest: bool = False):
        self.p, self.body, self.config, self.at_rest = p, body, config, at_rest
        self.frames: dict[int, np.ndarray] = {}
        self.knee_parent: dict[int, np.ndarray] = {}
        self._trunk()
        self._spine()
        self._collarbones()
        self._limbs()
        self._feet()

    def _l(self, a: str, b: str) -> np.ndarray:
        """The vector from joint a to joint b, `(T, 3)` m."""
        return self.p[:, self.body.roles[b]] - self.p[:, self.body.roles[a]]

    def _trunk(self) -> None:
        """Pelvis (parent of Eqs. 18, 19, 22) and the row that carries the shoulders (child, Eq. 16)."""
        body, bone = self.body, self._l
        top = body.chest
        if self.config.on("trunk_fit"):
            for row in (0, top):
                self.frames[row] = self._fitted(row)
            return
        # Eq. 18: x = l_rhip-lhip, y = l_root-rhip x l_root-lhip, z = x x y
        x, y = bone("rhip", "lhip"), cross(bone("root", "rhip"), bone("root", "lhip"))
        self.frames[0] = frame_of("x", x=x, y=y)
        if top == 0:
            return
        # Eq. 16: x = l_rcl-lcl, z = l_lowneck-lcl x l_lowneck-rcl, y = z x x
        x, z = bone("rcl", "lcl"), cross(bone("lowneck", "lcl"), bone("lowneck", "rcl"))
        self.frames[top] = frame_of("x", x=x, z=z)

    def _fitted(self, row: int) -> np.ndarray:
        """The trunk's frame carried by the rotation that fits all points rigidly attached to `row`."""
        body = self.body
        at = list(body.clusters[row])
        here = body.rest_pos[at] - body.rest_pos[at[0]]
        there = self.p[:, at] - self.p[:, at[:1]]
        # M = sum there here^T
        return best_rotation(np.einsum("tki,kj->tij", there, here))[0] @ body.trunk

    def _spine(self) -> None:
        """Eqs. 17 and 18: the rows between the pelvis and the lower neck."""
        body, p = self.body, self.p
        chain = (0, *body.spine)
        low, high = self.frames[0], self.frames[body.chest]
        for i in range(1, len(chain) - 1):
            along = p[:, chain[i + 1]] - p[:, chain[i]]
            below = p[:, chain[i - 1]] - p[:, chain[i]]
            y = normalize(np.where(norm(along, keepdims=True) < 1e-6, low[..., 1], along))
            if self.config.on("spine_twist"):
                # The twist goes evenly from the pelvis' x to the shoulders'.
                share = i / (len(chain) - 1)
                self.frames[chain[i]] = frame_of(
                    "y", x=(1 - share) * low[..., 0] + share * high[..., 0], y=y
                )
            else:
                # Eq. 17: y = l_th-lowneck, x = y x l_th-mspine, z = x x y
                x = normalize(cross(y, below))
                self.frames[chain[i]] = frame_of("y", x=x, y=y)

    def _collarbones(self) -> None:
        """Eqs. 12 and 15: x outward on the left and inward on the right, z by the mid spine below."""
        for side, a, b in (("l", "lcl", "ls"), ("r", "rs", "rcl")):
            roles = self.body.roles
            row = roles[f"{side}cl"]
            if row != roles[f"{side}s"] and self.body.table.rows[row].order:
                # Eq. 12: x_c = l_lcl-ls, z_c = l_lcl-mspine x x_c, y_c = z_c x x_c
                x = normalize(self._l(a, b))
                z = cross(self._l(f"{side}cl", "mspine"), x)
                self.frames[row] = frame_of("x", x=x, z=z)

    def _limbs(self) -> None:
        """Eqs. 10, 11, 13, 14 (arms) and 19, 20, 22, 23 (legs)."""
        p, body, config = self.p, self.body, self.config
        upper = normalize(np.stack([p[:, a.lower] - p[:, a.upper] for a in body.arms], 1))
        lower = normalize(np.stack([p[:, a.end] - p[:, a.lower] for a in body.arms], 1))
        normals = self._normals(upper, lower)
        arms = [k for k, a in enumerate(body.arms) if not a.leg]
        legs = [k for k, a in enumerate(body.arms) if a.leg]
        both, twice = np.concatenate((upper, lower), 1), np.concatenate((normals, normals), 1)
        # Eq. 10: x = l_ls-le and l_le-lw, z = -l_ls-le x l_le-lw. Eq. 13: x = l_re-rs and l_rw-re,
        # z = l_re-rw x l_re-rs. So x points outward on the left and inward on the right.
        way = np.array([[1.0] if body.arms[k].left else [-1.0] for k in arms * 2])
        at = arms + [k + len(body.arms) for k in arms]
        self._put(arms, frame_of("x", x=way * both[:, at], z=-way * twice[:, at]))
        if config.on("thigh_twist"):
            # Both bones of the leg carry the knee's axis, x = -y_c x l_lk-lhip of Eq. 20.
            at = legs + [k + len(body.arms) for k in legs]
            self._put(legs, frame_of("y", x=twice[:, at], y=-both[:, at]))
            return
        for k in legs:
            arm = body.arms[k]
            self._leg_of_hip_line(
                arm.upper, arm.lower, arm.left, upper[:, k], lower[:, k], normals[:, k]
            )

    def _put(self, arms: list[int], frames: np.ndarray) -> None:
        """Gives `frames (T, 2 n, 3, 3)` to the upper bones of n limbs, then to their lower bones."""
        rows = [self.body.arms[k].upper for k in arms] + [self.body.arms[k].lower for k in arms]
        self.frames.update({row: frames[:, i] for i, row in enumerate(rows)})

    def _leg_of_hip_line(
        self, thigh: int, shin: int, left: bool, u: np.ndarray, v: np.ndarray, n: np.ndarray
    ) -> None:
        """Eqs. 19 and 20 (left), 22 and 23 (right): the thigh's twist from the line of the hips."""
        y_p, y_c = -u, -v
        # Eq. 19: z = l_lhip-rhip x -y. Eq. 22: z = -y x l_rhip-lhip. Both point forward.
        hips = self._l("lhip", "rhip")
        z = normalize(cross(hips, -y_p))
        self.frames[thigh] = np.stack((cross(y_p, z), y_p, z), -1)
        # Eq. 20: x_c = -y_c x l_lk-lhip, z_c = x_c x y_c
        x = square_to(n, y_c) if self.config.on("hold_bend") or self.at_rest else n
        x = normalize(x)
        z_c = cross(x, y_c)
        self.frames[shin] = np.stack((x, y_c, z_c), -1)
        if left and not self.config.on("knee_subscripts"):
            # Eq. 20 as printed builds the parent from the child's y_c and z_c.
            x, z = cross(y_c, z_c), cross(hips, -y_c)
            self.knee_parent[shin] = np.stack((normalize(x), y_p, normalize(z)), -1)

    def _normals(self, upper: np.ndarray, lower: np.ndarray) -> np.ndarray:
        """Unit bend axes `(T, 4, 3)` of the limbs."""
        body, config = self.body, self.config
        if self.at_rest:
            return body.normals[None]
        if not config.on("hold_bend"):
            return bend_normals(upper, lower)
        rows = body.table.rows
        parents, rest = [], self.rest().frames
        for arm in body.arms:
            j = rows[arm.upper].parent
            while j not in self.frames:
                j = rows[j].parent
            # The parent's rotation from rest, F F_rest^T, carries vectors of the rest pose along.
            parents.append(self.frames[j] @ rest[j][0].T)
        bones = [normalize(body.rest_pos[a.lower] - body.rest_pos[a.upper]) for a in body.arms]
        return held_normals(
            upper,
            lower,
            np.stack(parents, 1),
            np.stack(bones),
            body.normals,
            config.straight,
            config.hold_frames,
        )

    def rest(self) -> BodyFrames:
        """The frames of the rest pose under the same equations."""
        return self if self.at_rest else rest_frames(self.body, self.config)

    def _feet(self) -> None:
        """Eqs. 21 and 24: the ankles, from shin and foot."""
        roles = self.body.roles
        for side in "lr":
            if f"{side}f" not in roles:
                continue
            ankle = roles[f"{side}an"]
            shin = self.frames[roles[f"{side}k"]]
            # Eq. 21: y_c = l_lan-lk, z_c = l_lan-lf
            y, z = (normalize(self._l(f"{side}an", f"{side}{to}")) for to in "kf")
            if self.config.on("square_ankle"):
                # z_c holds and y_c = z_c x x_c, with x_c the knee's axis made square to z_c: the same as
                # y_c x z_c for a foot that is bent or turned out, and still defined for one on pointe.
                self.frames[ankle] = frame_of("z", x=shin[..., 0], z=z)
            else:
                # x_c = y_c x z_c, with a shin y_c that is not square to z_c.
                self.frames[ankle] = np.stack((normalize(cross(y, z)), y, z), -1)


@lru_cache(maxsize=32)
def rest_frames(body: IkBody, config: IkConfig) -> BodyFrames:
    """`BodyFrames` of the humanoid's own rest pose, in which all angles are zero."""
    return BodyFrames(body.rest_pos[None], body, config, at_rest=True)


#: lambda of Eq. 7 (rad).
JUMP = 5.0
_AXIS = {"X": 0, "Y": 1, "Z": 2}


def zyx_angles(parent: np.ndarray, child: np.ndarray) -> np.ndarray:
    """Eq. 6: angles `(..., 3)` (E_z, E_y, E_x) of a child frame in its parent's, columns x, y, z.

    N, O and A are the child's axes in the parent's. Exact for square frames; E_y lies in +-90 degrees.
    """
    m = np.swapaxes(parent, -1, -2) @ child
    (n0, o0, a0), (n1, o1, a1), (n2, _, _) = np.moveaxis(m, (-2, -1), (0, 1))
    ez = np.arctan2(n1, n0)
    c, s = np.cos(ez), np.sin(ez)
    return np.stack(
        (ez, np.arctan2(-n2, n0 * c + n1 * s), np.arctan2(a0 * s - a1 * c, o1 * c - o0 * s)), -1
    )


def zyx_matrix(angles: np.ndarray) -> np.ndarray:
    """R_z R_y R_x `(..., 3, 3)` of angles (E_z, E_y, E_x)."""
    (cz, cy, cx), (sz, sy, sx) = (np.moveaxis(f(angles), -1, 0) for f in (np.cos, np.sin))
    x = np.stack((cz * cy, sz * cy, -sy), -1)
    y = np.stack((cz * sy * sx - sz * cx, sz * sy * sx + cz * cx, cy * sx), -1)
    z = np.stack((cz * sy * cx + sz * sx, sz * sy * cx - cz * sx, cy * cx), -1)
    return np.stack((x, y, z), -1)


def euler_angles(m: np.ndarray, order: str) -> np.ndarray:
    """Intrinsic angles `(..., 3)` of matrices, three different axes, the middle one in +-90 degrees."""
    i, j, k = (_AXIS[c] for c in order)
    s = 1.0 if (j - i) % 3 == 1 else -1.0
    # R = Ri(a) Rj(b) Rk(c):  R[i,k] = s sin b,  R[i,i] = cos b cos c,  R[j,k] = -s sin a cos b
    cos_b = np.hypot(m[..., i, i], m[..., i, j])
    locked = cos_b < 1e-7
    b = np.arctan2(s * m[..., i, k], cos_b)
    a = np.where(
        locked, np.arctan2(s * m[..., k, j], m[..., j, j]), np.arctan2(-s * m[..., j, k], m[..., k, k])
    )
    c = np.where(locked, 0.0, np.arctan2(-s * m[..., i, j], m[..., i, i]))
    return np.stack((a, b, c), -1)


def continuous_euler(m: np.ndarray, order: str, branches: bool = True) -> np.ndarray:
    """Angles `(T, R, 3)` of rotations `m (T, R, 3, 3)` for one hinge order, without jumps.

    With `branches` the smoothest sequence through both Euler branches and through gimbal lock, up to
    whole turns (`unwrapped`); without, Eq. 7 as it is printed.
    """
    angles = euler_angles(m, order)
    if not branches:
        return one_turn_check(angles)
    for r in np.flatnonzero((np.abs(angles[..., 1]) > math.pi / 2 - 1e-6).any(0)):
        angles[:, r] = through_lock(angles[:, r], order)
    return euler_path(angles)


def unwrapped(angles: np.ndarray) -> np.ndarray:
    """Angles `(T, ...)` without jumps of whole turns, the sequence shifted to lie nearest zero."""
    out = np.unwrap(angles, axis=0)
    return out - 2 * math.pi * np.round(np.median(out, axis=0) / (2 * math.pi))


def one_turn_check(angles: np.ndarray) -> np.ndarray:
    """Eq. 7: E_t+1 + 2 pi where E_t > 0, else E_t+1 - 2 pi, where they differ by more than lambda.

    Each frame is compared with the corrected one before it, so this goes frame by frame.
    """
    out = angles.copy()
    for t in range(len(out) - 1):
        jump = np.abs(out[t + 1] - out[t]) > JUMP
        out[t + 1] += np.where(jump, np.where(out[t] > 0, 2 * math.pi, -2 * math.pi), 0.0)
    return out


def pointing_angles(at_rest: np.ndarray, wanted: np.ndarray, order: str, axes: np.ndarray) -> np.ndarray:
    """Angles `(T, n)` of one or two hinges that turn direction `at_rest (3)` nearest to `wanted (T, 3)`.

    Both are unit and stated in the body at zero angles; `axes (3, 3)` holds the hinges' frame. One hinge
    turns the part across its axis onto that of the wanted direction. Two hinges reach any direction
    within their cone, in two ways of which the smoother one is taken; with i the first axis and k the
    second, e_i . R_k(c) v = e_i . w gives c, and a turns the rest about e_i. Up to whole turns
    (`unwrapped`).
    """
    v, w = axes.T @ at_rest, wanted @ axes
    i = _AXIS[order[0]]
    if len(order) == 1:
        return _about(np.broadcast_to(v, w.shape), w, i)[:, None]
    k = _AXIS[order[1]]
    m = 3 - i - k
    sign = 1.0 if (i + 1) % 3 == m else -1.0
    # R_k(c) carries e_i towards e_k x e_i = sign e_m.
    x, y = v[i], sign * v[m]
    size = max(math.hypot(x, y), 1e-9)
    half = np.arccos(np.clip(w[:, i] / size, -1.0, 1.0))
    phase = math.atan2(y, x)
    both = []
    for c in (half - phase, -half - phase):
        turned = np.empty_like(w)
        turned[:, k] = v[k]
        turned[:, i] = x * np.cos(c) - y * np.sin(c)
        turned[:, m] = sign * (x * np.sin(c) + y * np.cos(c))
        both.append(np.stack((_about(turned, w, i), c), -1))
    pair = wrapped(np.stack(both, 1))[:, None]  # (T, 1, 2, 2)
    step = wrapped(pair[1:, :, None, :] - pair[:-1, :, :, None])
    pick = best_path((step**2).sum(-1), 1e-2 * (pair**2).sum(-1))
    return np.take_along_axis(pair, pick[..., None, None], -2)[:, 0, 0]


def _about(v: np.ndarray, w: np.ndarray, axis: int) -> np.ndarray:
    """Angles `(T)` about one axis that bring `v (T, 3)` nearest to `w`; 0 where either lies on it."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    return np.arctan2(v[:, a] * w[:, b] - v[:, b] * w[:, a], v[:, a] * w[:, a] + v[:, b] * w[:, b])
