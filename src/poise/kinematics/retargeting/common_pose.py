"""The one pose in which all skeletons stand alike, so that rotations can pass between them."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from poise.body.topology import subtree
from poise.errors import PoiseError
from poise.kinematics.forward import carried
from poise.kinematics.retargeting.standing import (
    ClipWorld,
    Stances,
    hinge_axis,
    identity,
    mean_pose,
    pose_positions,
    rest_axes,
)
from poise.motion import Clip, Roles
from poise.motion.roles import SIDES
from poise.motion.rotations import (
    axis_angle_to_quat,
    normalize,
    quat_between,
    quat_mul,
    quat_rotate,
    quat_rotate_inv,
    shortest_arc,
)
from poise.motion.vectors import cross, norm

#: Where a skeleton has no toes: how far ahead of the ankle it treads, and how high such a point and the
#: ankle lie above the sole, as shares of the leg.
_TREAD, _TREAD_HEIGHT, _ANKLE_HEIGHT = 0.16, 0.025, 0.075
#: Tilt (rad) between the rest pose's foot and the standing foot of the motion, beyond which the motion
#: is believed.
_FOOT_TILT = math.radians(15)
#: Tips of bones that are longer than this share of a leg are mistakes of the file.
LONGEST_TIP = 0.4
#: Twist (rad) of a standing limb beyond which its hinge is not believed.
_MOST_TWIST = math.radians(100)
_NEXT = {"upper_arm": "forearm", "forearm": "hand", "thigh": "shin", "shin": "foot"}


@dataclass(frozen=True, eq=False)
class CommonPose:
    """A skeleton facing +x with vertical legs, arms 45 degrees from its sides and flat feet.

    roles: the skeleton and its parts.
    pos: `(J, 3)` m, the middle between the hip joints at the origin. rot: `(J, 4)` wxyz, world.
    above: `(J, 4)` wxyz, local rotations that joints above the pelvis keep.
    treads: `(2, 3)` m, in the frame of the left and right foot, the point on which it stands and rolls
    (toe joint, or where it would be). hip_height: m, of the hip joints over these points.
    tips: `(joint, (x, y, z) m)` in its frame, tips of bones that can be believed. sole: m, how far the
    lowest joint or tip of the standing feet lies under the treads.
    evidence: from what the pose was found, in a sentence.
    """

    roles: Roles
    pos: np.ndarray
    rot: np.ndarray
    above: np.ndarray
    treads: np.ndarray
    hip_height: float
    tips: tuple[tuple[int, tuple[float, float, float]], ...]
    sole: float
    evidence: str

    def depth(
        self, world: ClipWorld, ground: float = 0.0, joints: Collection[int] | None = None
    ) -> np.ndarray:
        """`(T)` m, how deep the lowest of some joints (default: all) and their tips is under the floor.

        The floor lies as far under the `ground` of the treads as the soles do while standing.
        """
        return np.maximum(ground - self.sole - self.lowest(world, joints), 0.0)

    def lowest(self, world: ClipWorld, joints: Collection[int] | None = None) -> np.ndarray:
        """`(T)` m, the lowest of those of `joints` (default: all) that are parts of the body, of their
        tips and treads; infinite without any part."""
        roles, (pos, quat) = self.roles, world
        joints = range(len(roles.skeleton)) if joints is None else joints
        heights = [pos[:, r.joint, 2] for r in roles.rows if r.joint in joints]
        feet = [(roles.joint(f"{side}_foot"), t) for side, t in zip(SIDES, self.treads, strict=True)]
        for j, tip in (*self.tips, *feet):
            if j in joints:
                heights.append(carried(pos[:, j], quat[:, j], tip)[:, 2])
        if not heights:
            return np.full((len(pos),), np.inf, dtype=pos.dtype)
        return np.stack(heights, -1).min(-1)


def common_pose(roles: Roles, clip: Clip | None = None, world: ClipWorld | None = None) -> CommonPose:
    """How the skeleton of `roles` stands in the pose that all skeletons share.

    It starts from the rest pose where a person could stand so, else from the mean pose of the upright
    frames of `clip` (skeletons such as LAFAN1's lie folded at rest), and swings each bone of the arms
    and legs by the smallest turn into its common direction, parents first. Where the motion shows about
    which axis a knee or elbow bends, its bones are twisted so that all bend alike; else twist is kept.
    Trunk, head, clavicles and fingers stay as they are.

    Args:
        clip: a motion of the skeleton. world: its joints in the world, where they are known already.

    Raises:
        PoiseError: a rest pose that does not stand and no clip, or legs of no length.
    """
    roles.require()
    _check_hips(roles)
    if clip is not None and world is None:
        world = ClipWorld.of(clip)
    at_rest = rest_axes(roles)
    if at_rest is not None:
        local = np.zeros((len(roles.skeleton), 4))
        local[:, 0] = 1.0
        local[0] = at_rest
        evidence = "its rest pose stands"
    elif clip is not None and world is not None:
        local = mean_pose(roles, clip, world)
        evidence = "its rest pose does not stand; the mean pose of the motion was taken"
    else:
        raise PoiseError(
            "the rest pose of this skeleton does not stand, so a motion must show how it stands",
            roles.skeleton.source.path,
            "Give a clip on it instead of the skeleton alone",
            code="rest-pose-unknown",
        )
    return _Builder(roles, local, clip, world, at_rest is not None, evidence).build()


def _check_hips(roles: Roles) -> None:
    """Refuses hips of no width, which face nowhere."""
    pos = roles.skeleton.rest_positions()
    left, right = (roles.joint(f"{side}_thigh") or 0 for side in SIDES)
    if float(np.linalg.norm(pos[left] - pos[right])) < 1e-4:
        names = roles.skeleton.names
        raise PoiseError(
            f"both legs ('{names[left]}' and '{names[right]}') hang on one point, so nothing tells "
            "where the body faces",
            roles.skeleton.source.path,
            code="facing-unknown",
        )


class _Builder:
    """Swings the limbs of a standing pose into their common directions."""

    def __init__(
        self,
        roles: Roles,
        local: np.ndarray,
        clip: Clip | None,
        world: ClipWorld | None,
        rested: bool,
        evidence: str,
    ) -> None:
        self.roles, self.local, self.clip, self.world = roles, local, clip, world
        self.rested, self.evidence = rested, evidence
        self.skeleton = roles.skeleton
        self.pos, self.quat = pose_positions(roles, local)
        self.leg = self._leg()
        feet = [(side, self._joint(f"{side}_foot")) for side in SIDES]
        toes = {j: self._toe(j, side) for side, j in feet}
        self.stance = Stances.of(world, 0.0 if clip is None else clip.fps, toes)

    def build(self) -> CommonPose:
        self._check_toes()
        rot = self.quat.copy()
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
        for side in SIDES:
            for kinds in (("upper_arm", "forearm", "hand"), ("thigh", "shin", "foot")):
                self._align_hinge(rot, side, kinds)
        parents = self.skeleton.parents
        local = np.stack(
            [rot[0]] + [quat_between(rot[p], rot[j]) for j, p in enumerate(parents) if p >= 0]
        )
        pos, rot = pose_positions(self.roles, local)
        hips = (pos[self._joint("left_thigh")] + pos[self._joint("right_thigh")]) / 2
        pos = pos - hips
        feet = [self._joint(f"{side}_foot") for side in SIDES]
        treads = np.stack([self._tread(pos, rot, side) for side in SIDES])
        heights = [
            float((pos[f] + quat_rotate(rot[f], t))[2]) for f, t in zip(feet, treads, strict=True)
        ]
        above = np.stack([identity()] * len(self.skeleton))
        if self.clip is not None and not self.rested:
            above = self.clip.rot[0]
        tread = float(np.mean(heights))
        tips = tuple((r.joint, v) for r in self.roles.rows if (v := self._believed(r.joint)) is not None)
        arrays = pos, rot, above, treads
        pose = CommonPose(self.roles, *arrays, -tread, tips, 0.0, self.evidence)
        low = pose.lowest(ClipWorld(pos[None], rot[None]))
        return replace(pose, sole=max(0.0, tread - float(low[0])))

    def _align_hinge(self, rot: np.ndarray, side: str, kinds: tuple[str, str, str]) -> None:
        """Twists the two bones of a limb until it bends as all limbs do: knees back, elbows forward.

        Hands and feet stay: palms and soles are known better from the standing pose.
        """
        joints = [self.roles.joint(f"{side}_{kind}") for kind in kinds]
        if self.world is None or any(j is None for j in joints):
            return
        limb = joints[0] or 0, joints[1] or 0, joints[2] or 0
        axis = hinge_axis(self.world, limb)
        if axis is None:
            return
        way = _way(side, kinds[0])
        ahead = np.array([1.0 if kinds[0] == "upper_arm" else -1.0, 0.0, 0.0], dtype=float)
        wanted, now = cross(way, ahead), quat_rotate(rot[limb[0]], axis)
        angle = np.arctan2(cross(now, wanted) @ way, now @ wanted)
        if float(np.abs(angle)) > _MOST_TWIST:
            return
        ends = subtree(self.skeleton, limb[2])
        for j in set(subtree(self.skeleton, limb[0])) - set(ends):
            rot[j] = quat_mul(axis_angle_to_quat(way, angle), rot[j])

    def _joint(self, role: str) -> int:
        joint = self.roles.joint(role)
        assert joint is not None
        return joint

    def _check_toes(self) -> None:
        """Refuses toes that point backwards: then left is right, and every turn would be mirrored."""
        ahead = []
        for side in SIDES:
            foot, toes = self._joint(f"{side}_foot"), self.roles.joint(f"{side}_toes")
            if toes is not None:
                line = self.pos[toes] - self.pos[foot]
                ahead.append(float(line[0] / np.maximum(norm(line), 1e-9)))
        if len(ahead) == 2 and max(ahead) < -0.5:
            raise PoiseError(
                "its toes point backwards, so left and right seem to be swapped",
                self.skeleton.source.path,
                "State the legs by hand with --map JOINT=right_thigh and so on",
                code="sides-swapped",
            )

    def _leg(self) -> float:
        total = 0.0
        for side in SIDES:
            thigh, shin, foot = (self.pos[self._joint(f"{side}_{k}")] for k in ("thigh", "shin", "foot"))
            bones = norm(shin - thigh), norm(foot - shin)
            if float(min(bones)) < 1e-4:
                raise PoiseError(
                    f"the {side} leg has a bone of no length",
                    self.skeleton.source.path,
                    code="zero-length-bone",
                )
            total += float(sum(bones)) / 2
        return total

    def _bone(self, j: int, side: str, kind: str) -> np.ndarray | None:
        """The bone from joint `j` to the next one of its limb, in its own frame; None where unknown."""
        if kind == "hand":
            tip = self._hand_tip(j, side)
        else:
            after = self.roles.joint(f"{side}_{_NEXT[kind]}")
            tip = None if after is None else self.pos[after]
        if tip is None or float(norm(tip - self.pos[j])) < 1e-4:
            return None
        return quat_rotate_inv(self.quat[j], tip - self.pos[j])

    def _believed(self, j: int) -> tuple[float, float, float] | None:
        """The tip of the bone at `j` in its frame; None without one or where no bone is so long."""
        for k, tip in self.skeleton.ends:
            if k == j and 1e-3 < float(np.linalg.norm(tip)) < LONGEST_TIP * self.leg:
                return tip
        return None

    def _tip(self, j: int) -> np.ndarray | None:
        tip = self._believed(j)
        return None if tip is None else np.asarray(tip, dtype=float)

    def _hand_tip(self, j: int, side: str) -> np.ndarray | None:
        for finger in ("middle", "fingers", "index", "ring"):
            joints = [x for n in (0, 1) if (x := self.roles.joint(f"{side}_{finger}{n}")) is not None]
            far = [x for x in joints if float(norm(self.pos[x] - self.pos[j])) > 1e-3]
            if far:
                return self.pos[far[0]]
        tip = self._tip(j)
        return None if tip is None else self.pos[j] + quat_rotate(self.quat[j], tip)

    def _toe(self, j: int, side: str) -> np.ndarray | None:
        """Where the foot points, in its own frame; None where the file does not say."""
        toes = self.roles.joint(f"{side}_toes")
        if toes is not None:
            return quat_rotate_inv(self.quat[j], self.pos[toes] - self.pos[j])
        return self._tip(j)

    def _foot(self, j: int, side: str) -> np.ndarray:
        """The foot's world rotation: flat, and its toe straight ahead."""
        rot, toe = self.quat[j], self._toe(j, side)
        if toe is None or float(norm(quat_rotate(rot, toe)[:2])) < 0.03 * self.leg:
            return rot
        if not self.rested:
            seen = self.stance.mean(j)
            rot = rot if seen is None else seen
        z, y = np.eye(3)[[2, 1]]
        ahead = quat_rotate(rot, toe)
        rot = quat_mul(axis_angle_to_quat(z, -np.arctan2(ahead[1], ahead[0])), rot)
        tilt = np.arctan2(ahead[2], norm(ahead[:2]))
        stood = self.stance.tilt()
        if stood is not None and (not self.rested or abs(stood - float(tilt)) > _FOOT_TILT):
            # A turn about +y by a positive angle lowers what points along +x.
            rot = quat_mul(axis_angle_to_quat(y, tilt - stood), rot)
        return rot

    def _tread(self, pos: np.ndarray, rot: np.ndarray, side: str) -> np.ndarray:
        """The point on which a foot stands and rolls, in the foot's frame."""
        j, toes = self._joint(f"{side}_foot"), self.roles.joint(f"{side}_toes")
        if toes is not None and float(norm(pos[toes] - pos[j])) > 0.03 * self.leg:
            return quat_rotate_inv(rot[j], pos[toes] - pos[j])
        tip = self._toe(j, side)
        low = 0.0 if tip is None else -float(quat_rotate(rot[j], tip)[2]) / self.leg
        # The tip of a toe lies on the sole at most; many were made up higher.
        ankle = low if _ANKLE_HEIGHT < low < 2 * _ANKLE_HEIGHT else _ANKLE_HEIGHT
        ahead = np.array([_TREAD, 0.0, _TREAD_HEIGHT - ankle], dtype=float) * self.leg
        return quat_rotate_inv(rot[j], ahead)


def _way(side: str, kind: str) -> np.ndarray:
    """The common direction of a limb's bone."""
    out = 1.0 if side == "left" else -1.0
    leg = kind in ("thigh", "shin")
    return normalize(np.array([0.0, 0.0 if leg else out, -1.0], dtype=float))
