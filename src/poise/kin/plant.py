"""Contacts carried over to another body: planted feet and hands stay planted, nothing sinks deeper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from poise.kin.common_pose import CommonPose
from poise.kin.contacts import contact_labels
from poise.kin.ground import smooth_hull
from poise.kin.limbs import Limb, match_positions
from poise.motion import Clip, Skeleton
from poise.motion.joint_map import JointMap
from poise.motion.roles import SIDES
from poise.spatial import forward_kinematics, quat_rotate

#: Time (s) over which a foot goes from its own path to its contact and back.
BLEND_S = 0.15
#: Heights (m, of a person of 0.85 m hip height) under which an ankle, a toe or a hand touches.
_LOW = {"tread": 0.05, "ankle": 0.05, "hand": 0.1}
_USUAL_HIPS = 0.85
_SLOW = 0.35


@dataclass(frozen=True)
class Ground:
    """Height (m) on which the source's feet tread, and how it was found."""

    height: float
    sentence: str


@dataclass(frozen=True)
class Scale:
    """The map of the source's space into the target's: x' = c + k (x - c), and its ground."""

    factor: float
    centre: tuple[float, float, float]
    ground: float
    hip_height: float

    @staticmethod
    def between(
        clip: Clip, joints: JointMap, here: CommonPose, there: CommonPose, factor: float | None
    ) -> Scale:
        """Scaled by the heights of the hips over the feet, about where the clip begins on its ground."""
        factor = there.hip_height / here.hip_height if factor is None else factor
        pos, quat = (torch.tensor(x) for x in clip.world())
        treads = []
        for side, tread in zip(SIDES, here.treads, strict=True):
            foot = joints.source.joint(f"{side}_foot") or 0
            treads.append(pos[:, foot] + quat_rotate(quat[:, foot], torch.tensor(tread).expand(len(pos), 3)))
        ground = tread_height(torch.stack(treads, 1), clip.fps)
        hips = [pos[0, joints.source.joint(f"{s}_thigh") or 0] for s in SIDES]
        middle = (hips[0] + hips[1]) / 2
        return Scale(factor, (float(middle[0]), float(middle[1]), ground), ground, here.hip_height)

    def place(self, x: Tensor) -> Tensor:
        """Points `(..., 3)` m of the source's world where the target has them."""
        centre = torch.tensor(self.centre, dtype=x.dtype)
        # Written so that a factor of 1 changes no digit.
        return x + (self.factor - 1.0) * (x - centre)


def tread_height(points: Tensor, fps: float) -> float:
    """The height (m) of the ground under points of the feet `(T, F, 3)`: the median of those at rest.

    At rest is the lower point of a frame while it moves slower than 0.35 m/s; without any, the tenth
    percentile of the lowest points counts.
    """
    low, which = points[..., 2].min(-1)
    step = torch.diff(points, dim=0).norm(dim=-1) * fps
    speed = torch.cat((step, step[-1:])).gather(1, which[:, None])[:, 0]
    slow = low[speed < _SLOW]
    if len(slow) < 5:
        return float(low.quantile(0.1))
    # A foot may rest in the air too; the lower half of the moments of rest is on the floor.
    return float(slow[slow <= slow.median() + 0.02].median())


@dataclass(frozen=True, eq=False)
class Foot:
    """One end that may touch the floor, in source and target.

    name: "left foot", ...; source, target: its joint in either. limb: the joints that move it in the
    target. tread_source, tread_target: `(3)` m, in its frame, the point that is held.
    """

    name: str
    source: int
    target: int
    limb: Limb
    tread_source: Tensor
    tread_target: Tensor

    def points(self, pos: Tensor, quat: Tensor, target: bool) -> Tensor:
        """`(T, 3)` m, where the held point is."""
        joint, tread = (self.target, self.tread_target) if target else (self.source, self.tread_source)
        return pos[:, joint] + quat_rotate(quat[:, joint], tread.expand(len(pos), 3))


def feet_of(joints: JointMap, here: CommonPose, there: CommonPose) -> tuple[Foot, ...]:
    """Both feet, and the hands that both skeletons have."""
    out = []
    for kinds, label in ((("thigh", "shin", "foot"), "foot"), (("upper_arm", "forearm", "hand"), "hand")):
        for k, side in enumerate(SIDES):
            pairs = [joints.limb_pair(f"{side}_{kind}") for kind in kinds]
            if any(p is None for p in pairs):
                continue
            chain = [p for p in pairs if p is not None]
            held = [torch.zeros(3, dtype=torch.float64)] * 2
            if label == "foot":
                held = [torch.tensor(here.treads[k]), torch.tensor(there.treads[k])]
            limb = Limb(*(p[1] for p in chain))
            out.append(Foot(f"{side} {label}", *chain[2], limb, held[0], held[1]))
    return tuple(out)


def source_contacts(clip: Clip, feet: tuple[Foot, ...], ground: float) -> Tensor:
    """`(T, F)` bool, which end touches the ground in the source: low and slow, at toe or ankle."""
    pos, quat = (torch.tensor(x) for x in clip.world())
    out = []
    for foot in feet:
        tread = foot.points(pos, quat, target=False)[:, None]
        if foot.name.endswith("hand"):
            out.append(contact_labels(tread, clip.fps, _LOW["hand"], _SLOW, ground)[:, 0])
            continue
        label = contact_labels(tread, clip.fps, _LOW["tread"], _SLOW, ground)[:, 0]
        out.append(label)
    return torch.stack(out, 1)


def plant(
    clip: Clip,
    skeleton: Skeleton,
    rot: Tensor,
    root: Tensor,
    feet: tuple[Foot, ...],
    contacts: Tensor,
    scale: Scale,
    hold: bool,
    clear: bool,
) -> tuple[Tensor, Tensor]:
    """New local rotations `(T, J, 4)` and root path `(T, 3)` of the target with its contacts kept.

    While an end touches, and blended over `BLEND_S` before and after, it goes where the source's is after
    scaling: what stood still stands still. Limbs that would then be under the floor by more than in the
    source are lifted, and where the trunk is, all of it. The limbs are solved by two bones in closed form;
    feet and hands keep their turn.
    """
    source_pos, source_quat = (torch.tensor(x) for x in clip.world())
    offsets = torch.tensor(skeleton.offsets)
    depth = allowed_depth(clip, scale)
    if clear:
        pos, quat = forward_kinematics(skeleton.parents, offsets, root, rot)
        rest = [j for j in range(len(skeleton)) if not any(_hangs(skeleton, j, f.limb.mid) for f in feet)]
        root = root.clone()
        root[:, 2] += _lift(_lowest(skeleton, pos, quat, rest), depth, scale, clip)
    pos, quat = forward_kinematics(skeleton.parents, offsets, root, rot)
    goals: dict[int | str, Tensor] = {}
    for k, foot in enumerate(feet):
        arm = quat_rotate(quat[:, foot.target], foot.tread_target.expand(len(pos), 3))
        goal = pos[:, foot.target]
        if hold:
            wanted = scale.place(foot.points(source_pos, source_quat, target=False)) - arm
            weight = contact_weight(contacts[:, k], clip.fps)[:, None]
            goal = goal + weight * (wanted - goal)
        if clear:
            below = [j for j in range(len(skeleton)) if _hangs(skeleton, j, foot.target)]
            moved = pos + (goal - pos[:, foot.target])[:, None]
            goal = goal.clone()
            goal[:, 2] += _lift(_lowest(skeleton, moved, quat, below), depth, scale, clip)
        goals[foot.target] = goal
    limbs: dict[int | str, Limb] = {foot.target: foot.limb for foot in feet}
    return match_positions(skeleton, rot, root, goals, limbs), root


def contact_weight(contact: Tensor, fps: float) -> Tensor:
    """`(T)` in [0, 1]: 1 where `contact (T)` holds, falling to 0 over `BLEND_S` around it."""
    if not bool(contact.any()):
        return torch.zeros(len(contact), dtype=torch.float64)
    frames = torch.arange(len(contact))
    at = frames[contact]
    k = torch.searchsorted(at, frames)
    after = at[k.clamp(max=len(at) - 1)]
    before = at[(k - 1).clamp(min=0)]
    away = torch.minimum((after - frames).abs(), (frames - before).abs()).double() / fps
    return 0.5 + 0.5 * torch.cos(torch.pi * (away / BLEND_S).clamp(max=1.0))


def allowed_depth(clip: Clip, scale: Scale) -> Tensor:
    """`(T)` m, how deep under its ground the target may be: as deep as the source, scaled."""
    pos, quat = (torch.tensor(x) for x in clip.world())
    low = _lowest(clip.skeleton, pos, quat, list(range(len(clip.skeleton))))
    return (scale.ground - low).clamp_min(0.0) * scale.factor


def _lift(low: Tensor, depth: Tensor, scale: Scale, clip: Clip) -> Tensor:
    """The smooth lift `(T)` m that keeps `low (T)` from being deeper than `depth (T)`."""
    excess = (scale.ground - low - depth).clamp_min(0.0).numpy()
    if excess.max() < 1e-6:
        return torch.zeros_like(low)
    reach = max(1, round(0.05 * clip.fps))
    return torch.tensor(np.maximum(smooth_hull(excess, reach, clip.cyclic), 0.0))


def _lowest(skeleton: Skeleton, pos: Tensor, quat: Tensor, joints: list[int]) -> Tensor:
    """`(T)` m, the lowest of some joints and of the bone tips on them."""
    heights = [pos[:, j, 2] for j in joints]
    for j, tip in skeleton.ends:
        if j in joints:
            reach = torch.tensor(tip, dtype=pos.dtype).expand(len(pos), 3)
            heights.append((pos[:, j] + quat_rotate(quat[:, j], reach))[:, 2])
    if not heights:
        return torch.full((len(pos),), torch.inf, dtype=pos.dtype)
    return torch.stack(heights, -1).min(-1).values


def _hangs(skeleton: Skeleton, joint: int, below: int) -> bool:
    """Whether `joint` is `below` or hangs on it."""
    while joint > below:
        joint = skeleton.parents[joint]
    return joint == below
