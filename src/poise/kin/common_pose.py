"""The one pose in which all skeletons stand alike, so that rotations can pass between them."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.kin.contacts import contact_labels
from poise.kin.limbs import shortest_arc
from poise.motion import Clip, Roles
from poise.motion.info import sampled
from poise.motion.roles import SIDES
from poise.spatial import (
    axis_angle_to_quat,
    forward_kinematics,
    matrix_to_quat,
    normalize,
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_rotate_inv,
)

#: Cosine of the largest angle between a limb and where it hangs in a rest pose that a person could hold.
_LIKE_STANDING = math.cos(math.radians(50))
#: Cosine of the lean up to which a person counts as upright.
_UPRIGHT = math.cos(math.radians(35))
#: Where a skeleton has no toes: how far ahead of the ankle it treads, and how high such a point and the
#: ankle lie above the sole, as shares of the leg.
_TREAD, _TREAD_HEIGHT, _ANKLE_HEIGHT = 0.16, 0.025, 0.09
#: Tilt (rad) between the rest pose's foot and the standing foot of the motion, beyond which the motion is
#: believed.
_FOOT_TILT = math.radians(15)
#: Tips of bones that are longer than this share of a leg are mistakes of the file.
LONGEST_TIP = 0.4
_NEXT = {"upper_arm": "forearm", "forearm": "hand", "thigh": "shin", "shin": "foot"}


@dataclass(frozen=True, eq=False)
class CommonPose:
    """A skeleton facing +x with vertical legs, arms 45 degrees from its sides and flat feet.

    pos: `(J, 3)` m, the middle between the hip joints at the origin. rot: `(J, 4)` wxyz, world.
    above: `(J, 4)` wxyz, local rotations that joints above the pelvis keep.
    treads: `(2, 3)` m, in the frame of the left and right foot, the point on which it stands and rolls
    (toe joint, or where it would be). hip_height: m, of the hip joints over these points.
    tips: `(joint, (x, y, z) m)` in its frame, tips of bones that can be believed. sole: m, how far the
    lowest joint or tip of the standing feet lies under the treads.
    evidence: from what the pose was found, in a sentence.
    """

    pos: np.ndarray
    rot: np.ndarray
    above: np.ndarray
    treads: np.ndarray
    hip_height: float
    tips: tuple[tuple[int, tuple[float, float, float]], ...]
    sole: float
    evidence: str

    def lowest(self, roles: Roles, pos: Tensor, quat: Tensor, joints: Collection[int]) -> Tensor:
        """`(T)` m, the lowest of those of `joints` that are parts of the body, of their tips and treads.

        pos, quat: `(T, J, 3)` and `(T, J, 4)`, world. Without any part it is infinite.
        """
        heights = [pos[:, r.joint, 2] for r in roles.rows if r.joint in joints]
        feet = [(roles.joint(f"{side}_foot"), t) for side, t in zip(SIDES, self.treads, strict=True)]
        for j, tip in (*self.tips, *feet):
            if j in joints:
                reach = torch.tensor(tip, dtype=pos.dtype).expand(len(pos), 3)
                heights.append((pos[:, j] + quat_rotate(quat[:, j], reach))[:, 2])
        if not heights:
            return torch.full((len(pos),), torch.inf, dtype=pos.dtype)
        return torch.stack(heights, -1).min(-1).values


def common_pose(roles: Roles, clip: Clip | None = None) -> CommonPose:
    """How the skeleton of `roles` stands in the pose that all skeletons share.

    It starts from the rest pose where a person could stand so, else from the mean pose of the upright
    frames of `clip` (skeletons such as LAFAN1's lie folded at rest), and swings each bone of the arms and
    legs by the smallest turn into its common direction, parents first, so that its twist is kept. Trunk,
    head, clavicles and fingers stay as they are.

    Raises:
        PoiseError: a rest pose in which nobody stands and no clip, or legs of no length.
    """
    roles.require()
    at_rest = _rest_axes(roles)
    if at_rest is not None:
        local = torch.zeros(len(roles.skeleton), 4, dtype=torch.float64)
        local[:, 0] = 1.0
        local[0] = at_rest
        evidence = "its rest pose stands"
    elif clip is not None:
        local = _mean_pose(roles, clip)
        evidence = "nobody stands as in its rest pose; the mean pose of the motion was taken"
    else:
        raise PoiseError(
            "nobody stands as in the rest pose of this skeleton, so a motion must show how it stands",
            roles.skeleton.source.path,
            "Give a clip on it instead of the skeleton alone",
        )
    return _Builder(roles, local, clip, rested=at_rest is not None, evidence=evidence).build()


def pose_positions(roles: Roles, local: Tensor) -> tuple[Tensor, Tensor]:
    """World positions `(J, 3)` and rotations `(J, 4)` of local rotations `(J, 4)`, root at the origin."""
    skeleton = roles.skeleton
    zero = torch.zeros(3, dtype=torch.float64)
    return forward_kinematics(skeleton.parents, torch.tensor(skeleton.offsets), zero, local)


def body_axes(roles: Roles, pos: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vectors to the left (hip to hip) and up (hips to shoulders, neck or head), each `(..., 3)`."""

    def of(role: str) -> Tensor:
        joint = roles.joint(role)
        assert joint is not None
        return pos[..., joint, :]

    left = of("left_thigh") - of("right_thigh")
    hips = (of("left_thigh") + of("right_thigh")) / 2
    if roles.missing(("left_upper_arm", "right_upper_arm")):
        tops = [*roles.chain("head"), *roles.chain("neck"), *roles.chain("spine")[::-1]]
        if not tops:
            raise PoiseError("the skeleton has neither arms nor spine above its legs")
        top = pos[..., tops[0], :]
    else:
        top = (of("left_upper_arm") + of("right_upper_arm")) / 2
    return normalize(left), normalize(top - hips)


def _rest_axes(roles: Roles) -> Tensor | None:
    """wxyz that turns the rest pose to stand and face +x, None where nobody could stand so."""
    pos = torch.tensor(roles.skeleton.rest_positions())
    left, up = body_axes(roles, pos)
    # The nearest axis of the file: a rest pose stands, or lies as a whole.
    axis = torch.zeros(3, dtype=torch.float64)
    k = int(up.abs().argmax())
    axis[k] = 1.0 if up[k] > 0 else -1.0
    lines = [up @ axis]
    for side in SIDES:
        thigh, shin, foot = (pos[roles.joint(f"{side}_{k}") or 0] for k in ("thigh", "shin", "foot"))
        lines += [normalize(shin - thigh) @ -axis, normalize(foot - shin) @ -axis]
    if min(float(x) for x in lines) < _LIKE_STANDING or abs(float(left @ axis)) > 0.3:
        return None
    return _facing(left, axis)


def _facing(left: Tensor, up: Tensor) -> Tensor:
    """wxyz `(..., 4)` that turns `up` onto +z and the part of `left` across it onto +y."""
    y = normalize(left - (left * up).sum(-1, keepdim=True) * up)
    # Rows are the body's axes, so the matrix turns them onto the world's.
    return matrix_to_quat(torch.stack((torch.linalg.cross(y, up), y, up), -2))


def _mean_pose(roles: Roles, clip: Clip) -> Tensor:
    """`(J, 4)` wxyz local, mean over upright frames; standing upright and facing +x.

    A joint's mean rotation is the principal eigenvector of the sum of q q^T (Markley et al. 2007).
    """
    frames = sampled(clip.frames, 2000)
    part = clip.replaced(root_pos=clip.root_pos[frames], rot=clip.rot[frames])
    pos, quat = (torch.tensor(x) for x in part.world())
    left, up = body_axes(roles, pos)
    chosen = up[:, 2] > _UPRIGHT
    if int(chosen.sum()) < max(2, len(frames) // 50):
        # Hardly ever upright: the most upright tenth.
        chosen = up[:, 2] >= up[:, 2].quantile(0.9)
    local = torch.stack([_mean(torch.tensor(part.rot[:, j])[chosen]) for j in range(len(clip.skeleton))])
    hips = roles.joint("hips") or 0
    vertical = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(int(chosen.sum()), 3)
    heading = _facing(left[chosen], vertical)
    level = _mean(quat_mul(heading, quat[chosen, hips]))
    # The root is turned so that the pelvis stands as it does on average, then that the trunk is upright.
    local[0] = _one()
    rest = pose_positions(roles, local)[1][hips]
    local[0] = quat_mul(level, quat_conj(rest))
    _, lean = body_axes(roles, pose_positions(roles, local)[0])
    local[0] = quat_mul(shortest_arc(lean, vertical[0]), local[0])
    left_now, _ = body_axes(roles, pose_positions(roles, local)[0])
    local[0] = quat_mul(_facing(left_now, vertical[0]), local[0])
    return local


def _mean(q: Tensor) -> Tensor:
    return torch.linalg.eigh(q.T @ q)[1][:, -1]


def _one() -> Tensor:
    return torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)


class _Builder:
    """Swings the limbs of a standing pose into their common directions."""

    def __init__(
        self, roles: Roles, local: Tensor, clip: Clip | None, rested: bool, evidence: str
    ) -> None:
        self.roles, self.local, self.clip = roles, local, clip
        self.rested, self.evidence = rested, evidence
        self.skeleton = roles.skeleton
        self.pos, self.quat = pose_positions(roles, local)
        self.leg = self._leg()
        self.standing = self._standing_tilt()

    def build(self) -> CommonPose:
        rot = self.quat.clone()
        for j in range(1, len(self.skeleton)):
            rot[j] = quat_mul(rot[self.skeleton.parents[j]], self.local[j])
            role = self.roles.role(j)
            if role is None:
                continue
            side = "left" if role.startswith("left_") else "right"
            kind = role.removeprefix(f"{side}_")
            if kind == "foot":
                rot[j] = self._foot(j, side)
            elif kind in (*_NEXT, "hand"):
                bone = self._bone(j, side, kind)
                if bone is not None:
                    rot[j] = quat_mul(shortest_arc(quat_rotate(rot[j], bone), _way(side, kind)), rot[j])
        parents = self.skeleton.parents
        local = torch.stack(
            [rot[0]] + [quat_mul(quat_conj(rot[p]), rot[j]) for j, p in enumerate(parents) if p >= 0]
        )
        pos, rot = pose_positions(self.roles, local)
        hips = (pos[self._joint("left_thigh")] + pos[self._joint("right_thigh")]) / 2
        pos = pos - hips
        feet = [self._joint(f"{side}_foot") for side in SIDES]
        treads = torch.stack([self._tread(pos, rot, side) for side in SIDES])
        heights = [
            float((pos[f] + quat_rotate(rot[f], t))[2]) for f, t in zip(feet, treads, strict=True)
        ]
        above = torch.stack([_one()] * len(self.skeleton))
        if self.clip is not None and not self.rested:
            above = torch.tensor(self.clip.rot[0])
        tread = float(np.mean(heights))
        tips = tuple((r.joint, v) for r in self.roles.rows if (v := self._believed(r.joint)) is not None)
        pose = CommonPose(
            *(x.numpy() for x in (pos, rot, above, treads)), -tread, tips, 0.0, self.evidence
        )
        low = pose.lowest(self.roles, pos[None], rot[None], range(len(self.skeleton)))
        return replace(pose, sole=max(0.0, tread - float(low[0])))

    def _joint(self, role: str) -> int:
        joint = self.roles.joint(role)
        assert joint is not None
        return joint

    def _leg(self) -> float:
        total = 0.0
        for side in SIDES:
            thigh, shin, foot = (self.pos[self._joint(f"{side}_{k}")] for k in ("thigh", "shin", "foot"))
            bones = (shin - thigh).norm(), (foot - shin).norm()
            if float(min(bones)) < 1e-4:
                raise PoiseError(f"the {side} leg has a bone of no length", self.skeleton.source.path)
            total += float(sum(bones)) / 2
        return total

    def _bone(self, j: int, side: str, kind: str) -> Tensor | None:
        """The bone from joint `j` to the next one of its limb, in its own frame; None where unknown."""
        if kind == "hand":
            tip = self._hand_tip(j, side)
        else:
            after = self.roles.joint(f"{side}_{_NEXT[kind]}")
            tip = None if after is None else self.pos[after]
        if tip is None or float((tip - self.pos[j]).norm()) < 1e-4:
            return None
        return quat_rotate_inv(self.quat[j], tip - self.pos[j])

    def _believed(self, j: int) -> tuple[float, float, float] | None:
        """The tip of the bone at `j` in its frame; None without one, or where no hand or foot is so long."""
        for k, tip in self.skeleton.ends:
            if k == j and 1e-3 < float(np.linalg.norm(tip)) < LONGEST_TIP * self.leg:
                return tip
        return None

    def _tip(self, j: int) -> Tensor | None:
        tip = self._believed(j)
        return None if tip is None else torch.tensor(tip, dtype=torch.float64)

    def _hand_tip(self, j: int, side: str) -> Tensor | None:
        for finger in ("middle", "fingers", "index", "ring"):
            joints = [x for n in (0, 1) if (x := self.roles.joint(f"{side}_{finger}{n}")) is not None]
            far = [x for x in joints if float((self.pos[x] - self.pos[j]).norm()) > 1e-3]
            if far:
                return self.pos[far[0]]
        tip = self._tip(j)
        return None if tip is None else self.pos[j] + quat_rotate(self.quat[j], tip)

    def _toe(self, j: int, side: str) -> Tensor | None:
        """Where the foot points, in its own frame; None where the file does not say."""
        toes = self.roles.joint(f"{side}_toes")
        if toes is not None:
            return quat_rotate_inv(self.quat[j], self.pos[toes] - self.pos[j])
        return self._tip(j)

    def _foot(self, j: int, side: str) -> Tensor:
        """The foot's world rotation: flat, and its toe straight ahead."""
        rot, toe = self.quat[j], self._toe(j, side)
        if toe is None:
            return rot
        ahead = quat_rotate(rot, toe)
        if float(ahead[:2].norm()) < 0.03 * self.leg:
            return rot
        z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        rot = quat_mul(axis_angle_to_quat(z, -torch.atan2(ahead[1], ahead[0])), rot)
        tilt = float(torch.atan2(ahead[2], ahead[:2].norm()))
        stood = self.standing
        if stood is not None and (not self.rested or abs(stood - tilt) > _FOOT_TILT):
            y = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
            # A turn about +y by a positive angle lowers what points along +x.
            rot = quat_mul(axis_angle_to_quat(y, torch.tensor(tilt - stood, dtype=torch.float64)), rot)
        return rot

    def _standing_tilt(self) -> float | None:
        """How far (rad) the line from ankle to toe rises: median over the moments in which a foot stands."""
        if self.clip is None:
            return None
        found = []
        pos, quat = (torch.tensor(x) for x in self.clip.world())
        for side in SIDES:
            j = self._joint(f"{side}_foot")
            toe = self._toe(j, side)
            if toe is None:
                continue
            line = quat_rotate(quat[:, j], toe.expand(len(pos), 3))
            points = torch.stack((pos[:, j], pos[:, j] + line), 1)
            grounds = points[..., 2].quantile(0.1, dim=0)
            stands = [
                contact_labels(points[:, k : k + 1], self.clip.fps, 0.03, 0.35, float(grounds[k]))[:, 0]
                for k in (0, 1)
            ]
            flat = line[stands[0] & stands[1]]
            found.append(torch.atan2(flat[:, 2], flat[:, :2].norm(dim=-1)))
        tilts = torch.cat(found) if found else torch.zeros(0)
        return float(tilts.median()) if len(tilts) >= 5 else None

    def _tread(self, pos: Tensor, rot: Tensor, side: str) -> Tensor:
        """The point on which a foot stands and rolls, in the foot's frame."""
        j, toes = self._joint(f"{side}_foot"), self.roles.joint(f"{side}_toes")
        if toes is not None and float((pos[toes] - pos[j]).norm()) > 0.03 * self.leg:
            return quat_rotate_inv(rot[j], pos[toes] - pos[j])
        high = self._ankle_height(j) - _TREAD_HEIGHT * self.leg
        ahead = torch.tensor([_TREAD * self.leg, 0.0, -max(high, 0.0)], dtype=torch.float64)
        return quat_rotate_inv(rot[j], ahead)

    def _ankle_height(self, j: int) -> float:
        """Height (m) of a standing ankle over the floor of the clip, or what is usual."""
        usual = _ANKLE_HEIGHT * self.leg
        if self.clip is None:
            return usual
        low = float(np.quantile(self.clip.positions()[:, j, 2], 0.2))
        return low if 0.4 * usual < low < 1.6 * usual else usual


def _way(side: str, kind: str) -> Tensor:
    """The common direction of a limb's bone."""
    out = 1.0 if side == "left" else -1.0
    leg = kind in ("thigh", "shin")
    return normalize(torch.tensor([0.0, 0.0 if leg else out, -1.0], dtype=torch.float64))
