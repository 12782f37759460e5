"""Frames of body parts from joint positions: Eqs. 10 to 24 of Skeleton2Humanoid, and their repair.

l_ab is the vector from joint a to joint b. Left is +x, up is +y and forward is +z of a standing body.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.kin.ik.bend import bend_normals, frame_of, held_normals, square_to
from poise.kin.ik.body import IkBody
from poise.spatial import best_rotation, normalize

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
class IkConfig:
    """How the paper's equations are read.

    faithful: "corrected" or "paper"; what every correction below (see `CORRECTIONS`) takes that is None.
    straight: rad, the bend of a limb below which its bend plane is held. hold_frames: over how long.
    """

    faithful: str = "corrected"
    knee_subscripts: bool | None = None
    square_ankle: bool | None = None
    hold_bend: bool | None = None
    spine_twist: bool | None = None
    trunk_fit: bool | None = None
    thigh_twist: bool | None = None
    branches: bool | None = None
    straight: float = math.radians(3.0)
    hold_frames: float = 5.0

    def __post_init__(self) -> None:
        if self.faithful not in ("corrected", "paper"):
            raise PoiseError(f"faithful must be corrected or paper, got '{self.faithful}'")
        if not (0.0 < self.straight < math.pi / 2 and self.hold_frames > 0.0):
            raise PoiseError(
                "straight must lie between 0 and pi / 2 and hold_frames above 0, got "
                f"{self.straight:g} and {self.hold_frames:g}"
            )

    def on(self, correction: str) -> bool:
        """Whether one of `CORRECTIONS` is made."""
        chosen = getattr(self, correction)
        return self.faithful == "corrected" if chosen is None else chosen

    @property
    def square(self) -> bool:
        """Whether all frames are square, so that Eq. 6 changes nothing."""
        return all(self.on(c) for c in CORRECTIONS if c != "branches")


class Frames:
    """World frames `(T, 3, 3)` of rows from the positions `p (T, P, 3)` of one motion.

    frames: row -> its frame, columns x, y, z; square except where an error of the paper is kept.
    knee_parent: rows of shins for which the paper states the parent's frame otherwise (Eq. 20).
    """

    def __init__(self, p: Tensor, body: IkBody, config: IkConfig, at_rest: bool = False):
        self.p, self.body, self.config, self.at_rest = p, body, config, at_rest
        self.frames: dict[int, Tensor] = {}
        self.knee_parent: dict[int, Tensor] = {}
        self._trunk()
        self._spine()
        self._collarbones()
        self._limbs()
        self._feet()

    def _l(self, a: str, b: str) -> Tensor:
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
        x, y = bone("rhip", "lhip"), torch.linalg.cross(bone("root", "rhip"), bone("root", "lhip"))
        self.frames[0] = frame_of("x", x=x, y=y)
        if top == 0:
            return
        # Eq. 16: x = l_rcl-lcl, z = l_lowneck-lcl x l_lowneck-rcl, y = z x x
        x, z = bone("rcl", "lcl"), torch.linalg.cross(bone("lowneck", "lcl"), bone("lowneck", "rcl"))
        self.frames[top] = frame_of("x", x=x, z=z)

    def _fitted(self, row: int) -> Tensor:
        """The trunk's frame carried by the rotation that fits all points rigidly attached to `row`."""
        body = self.body
        at = list(body.clusters[row])
        here = body.rest_pos[at] - body.rest_pos[at[0]]
        there = self.p[:, at] - self.p[:, at[:1]]
        # M = sum there here^T
        return best_rotation(torch.einsum("tki,kj->tij", there, here))[0] @ body.trunk

    def _spine(self) -> None:
        """Eqs. 17 and 18: the rows between the pelvis and the lower neck."""
        body, p = self.body, self.p
        chain = (0, *body.spine)
        low, high = self.frames[0], self.frames[body.chest]
        for i in range(1, len(chain) - 1):
            along = p[:, chain[i + 1]] - p[:, chain[i]]
            below = p[:, chain[i - 1]] - p[:, chain[i]]
            y = normalize(torch.where(along.norm(dim=-1, keepdim=True) < 1e-6, low[..., 1], along))
            if self.config.on("spine_twist"):
                # The twist goes evenly from the pelvis' x to the shoulders'.
                share = i / (len(chain) - 1)
                self.frames[chain[i]] = frame_of(
                    "y", x=(1 - share) * low[..., 0] + share * high[..., 0], y=y
                )
            else:
                # Eq. 17: y = l_th-lowneck, x = y x l_th-mspine, z = x x y
                x = normalize(torch.linalg.cross(y, below))
                self.frames[chain[i]] = frame_of("y", x=x, y=y)

    def _collarbones(self) -> None:
        """Eqs. 12 and 15: x outward on the left and inward on the right, z by the mid spine below."""
        for side, a, b in (("l", "lcl", "ls"), ("r", "rs", "rcl")):
            roles = self.body.roles
            row = roles[f"{side}cl"]
            if row != roles[f"{side}s"] and self.body.table.rows[row].order:
                # Eq. 12: x_c = l_lcl-ls, z_c = l_lcl-mspine x x_c, y_c = z_c x x_c
                x = normalize(self._l(a, b))
                z = torch.linalg.cross(self._l(f"{side}cl", "mspine"), x)
                self.frames[row] = frame_of("x", x=x, z=z)

    def _limbs(self) -> None:
        """Eqs. 10, 11, 13, 14 (arms) and 19, 20, 22, 23 (legs)."""
        p, body, config = self.p, self.body, self.config
        upper = normalize(torch.stack([p[:, a.lower] - p[:, a.upper] for a in body.arms], 1))
        lower = normalize(torch.stack([p[:, a.end] - p[:, a.lower] for a in body.arms], 1))
        normals = self._normals(upper, lower)
        arms = [k for k, a in enumerate(body.arms) if not a.leg]
        legs = [k for k, a in enumerate(body.arms) if a.leg]
        both, twice = torch.cat((upper, lower), 1), torch.cat((normals, normals), 1)
        # Eq. 10: x = l_ls-le and l_le-lw, z = -l_ls-le x l_le-lw. Eq. 13: x = l_re-rs and l_rw-re,
        # z = l_re-rw x l_re-rs. So x points outward on the left and inward on the right.
        way = p.new_tensor([[1.0] if body.arms[k].left else [-1.0] for k in arms * 2])
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

    def _put(self, arms: list[int], frames: Tensor) -> None:
        """Gives `frames (T, 2 n, 3, 3)` to the upper bones of n limbs, then to their lower bones."""
        rows = [self.body.arms[k].upper for k in arms] + [self.body.arms[k].lower for k in arms]
        self.frames.update({row: frames[:, i] for i, row in enumerate(rows)})

    def _leg_of_hip_line(
        self, thigh: int, shin: int, left: bool, u: Tensor, v: Tensor, n: Tensor
    ) -> None:
        """Eqs. 19 and 20 (left), 22 and 23 (right): the thigh's twist from the line of the hips."""
        y_p, y_c = -u, -v
        # Eq. 19: z = l_lhip-rhip x -y. Eq. 22: z = -y x l_rhip-lhip. Both point forward.
        hips = self._l("lhip", "rhip")
        z = normalize(torch.linalg.cross(hips, -y_p))
        self.frames[thigh] = torch.stack((torch.linalg.cross(y_p, z), y_p, z), -1)
        # Eq. 20: x_c = -y_c x l_lk-lhip, z_c = x_c x y_c
        x = square_to(n, y_c) if self.config.on("hold_bend") or self.at_rest else n
        x = normalize(x)
        z_c = torch.linalg.cross(x, y_c)
        self.frames[shin] = torch.stack((x, y_c, z_c), -1)
        if left and not self.config.on("knee_subscripts"):
            # Eq. 20 as printed builds the parent from the child's y_c and z_c.
            x, z = torch.linalg.cross(y_c, z_c), torch.linalg.cross(hips, -y_c)
            self.knee_parent[shin] = torch.stack((normalize(x), y_p, normalize(z)), -1)

    def _normals(self, upper: Tensor, lower: Tensor) -> Tensor:
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
            torch.stack(parents, 1),
            torch.stack(bones),
            body.normals,
            config.straight,
            config.hold_frames,
        )

    def rest(self) -> Frames:
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
                self.frames[ankle] = torch.stack((normalize(torch.linalg.cross(y, z)), y, z), -1)


@lru_cache(maxsize=32)
def rest_frames(body: IkBody, config: IkConfig) -> Frames:
    """`Frames` of the humanoid's own rest pose, in which all angles are zero."""
    return Frames(body.rest_pos[None], body, config, at_rest=True)
