"""Contacts carried over to another body: planted feet and hands stay planted, nothing sinks deeper.

Hands may keep their places all the time, see `HandPlaces`."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from poise.body.topology import subtree
from poise.kinematics.feet import TOUCH_M, contact_labels
from poise.kinematics.forward import carried
from poise.kinematics.limbs import Limb, match_positions
from poise.kinematics.retargeting.hands import FOLDED, HandPlaces, calm_elbow
from poise.kinematics.retargeting.passage import Retargeter
from poise.kinematics.retargeting.standing import ClipWorld
from poise.motion import Clip
from poise.motion.roles import SIDES
from poise.motion.rotations import quat_rotate
from poise.motion.smoothing import smooth_lift

#: Time (s) over which a foot goes from its own path to its contact and back.
BLEND_S = 0.25
#: Half the time (s) over which a lift is spread.
LIFT_S = 0.05
#: Rounds of hands that keep their places: each arm learns where the other one is.
ROUNDS = 2
#: See `limbs.soft_reach`: an arm that is too short for a place does not snap straight.
SOFT_ARM = 0.05


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
    tread_source: np.ndarray
    tread_target: np.ndarray

    @property
    def is_hand(self) -> bool:
        """True for the end of an arm."""
        return self.name.endswith("hand")

    def points(self, pos: np.ndarray, quat: np.ndarray, target: bool) -> np.ndarray:
        """`(T, 3)` m, where the held point is."""
        joint, tread = (self.target, self.tread_target) if target else (self.source, self.tread_source)
        return carried(pos[:, joint], quat[:, joint], tread)


def feet_of(passage: Retargeter) -> tuple[Foot, ...]:
    """Both feet, and the hands that both skeletons have."""
    here, there = passage.here, passage.there
    out = []
    for kinds, label in (
        (("thigh", "shin", "foot"), "foot"),
        (("upper_arm", "forearm", "hand"), "hand"),
    ):
        for k, side in enumerate(SIDES):
            pairs = [passage.joints.limb_pair(f"{side}_{kind}") for kind in kinds]
            if any(p is None for p in pairs):
                continue
            chain = [p for p in pairs if p is not None]
            bones = np.diff(there.pos[[p[1] for p in chain]], axis=0)
            if np.linalg.norm(bones, axis=-1).min() < 1e-4:
                # A bone of no length reaches nowhere.
                continue
            held = [np.zeros(3)] * 2
            if label == "foot":
                held = [here.treads[k], there.treads[k]]
            limb = Limb(*(p[1] for p in chain))
            out.append(Foot(f"{side} {label}", *chain[2], limb, held[0], held[1]))
    return tuple(out)


def source_contacts(clip: Clip, world: ClipWorld, feet: tuple[Foot, ...], ground: float) -> np.ndarray:
    """`(T, F)` bool, which end touches the ground in the source: as its file says, else low and slow."""
    out, said = [], dict(clip.contacts)
    for foot in feet:
        if foot.source in said:
            out.append(said[foot.source].any(1))
            continue
        tread = foot.points(*world, target=False)[:, None]
        low = TOUCH_M[foot.name.split()[1]]
        out.append(contact_labels(tread, clip.fps, low, ground=ground)[:, 0])
    return np.stack(out, 1)


def plant(
    clip: Clip,
    world: ClipWorld,
    passage: Retargeter,
    rot: np.ndarray,
    root: np.ndarray,
    feet: tuple[Foot, ...],
    contacts: np.ndarray,
    hold: bool,
    clear: bool,
    places: HandPlaces | None = None,
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """New local rotations `(T, J, 4)` and root path `(T, 3)` of the target with its contacts kept, and
    `(T, 3)` m, where hands of `places` are to be, by their names.

    While an end touches, and blended over `BLEND_S` before and after, it goes where the source's is
    after scaling: what stood still stands still. Limbs that would then be under the floor by more than
    in the source are lifted; where trunk, knees or elbows are, or a limb does not reach, the whole body
    is. The limbs are solved by two bones in closed form; feet and hands keep their turn. Elbows of hands
    that keep their places bend smoothly (`calm_elbow`).
    """
    skeleton, scale = passage.joints.target.skeleton, passage.scale
    depth = passage.here.depth(world, scale.ground) * scale.factor

    def lift(pos: np.ndarray, quat: np.ndarray, parts: Collection[int]) -> np.ndarray:
        """The smooth lift `(T)` m that keeps some joints from being deeper than the source is."""
        excess = passage.there.depth(ClipWorld(pos, quat), scale.ground, parts) - depth
        if float(excess.max()) < 1e-6:
            return np.zeros(len(pos), dtype=pos.dtype)
        return smooth_lift(np.maximum(excess, 0.0), clip.fps, LIFT_S, clip.cyclic)

    if clear:
        ends = {j for foot in feet for j in subtree(skeleton, foot.target)}
        pos, quat = skeleton.forward(root, rot)
        up = np.zeros_like(root)
        up[:, 2] = lift(pos, quat, set(range(len(skeleton))) - ends)
        root = root + up

    def lifted(k: int, goal: np.ndarray, pos: np.ndarray, quat: np.ndarray) -> np.ndarray:
        """The place of an end, where it is no deeper than the source's."""
        if not clear:
            return goal
        joint, up = feet[k].target, np.zeros_like(goal)
        moved = pos + (goal - pos[:, joint])[:, None]
        up[:, 2] = lift(moved, quat, subtree(skeleton, joint))
        return goal + up

    pos, quat = skeleton.forward(root, rot)
    goals: dict[int | str, np.ndarray] = {}
    hands = [k for k, foot in enumerate(feet) if foot.is_hand and places]
    for k, foot in enumerate(feet):
        if k in hands:
            continue
        goal = pos[:, foot.target]
        if hold:
            arm = quat_rotate(quat[:, foot.target], np.broadcast_to(foot.tread_target, (len(pos), 3)))
            wanted = scale.place(foot.points(*world, target=False)) - arm
            goal = goal + contact_weight(contacts[:, k], clip.fps)[:, None] * (wanted - goal)
        goals[foot.target] = lifted(k, goal, pos, quat)
    by_end: dict[int | str, Limb] = {foot.target: foot.limb for foot in feet}
    rot = match_positions(skeleton, rot, root, goals, by_end)
    kept: dict[str, np.ndarray] = {}
    before = rot
    for _ in range(ROUNDS if hands and places else 0):
        assert places is not None
        pos, quat = skeleton.forward(root, rot)
        for k in hands:
            foot, grounded = feet[k], contact_weight(contacts[:, k], clip.fps)
            goal = places.of((foot.source, foot.target), foot.name.split()[0], pos, grounded)
            kept[foot.name] = lifted(k, goal, pos, quat)
        goals = {feet[k].target: kept[feet[k].name] for k in hands}
        rot = match_positions(skeleton, rot, root, goals, by_end, soft=SOFT_ARM, fold=FOLDED)
    for k in hands:
        foot, grounded = feet[k], contact_weight(contacts[:, k], clip.fps)
        rot, goal = calm_elbow(skeleton, before, rot, root, foot.limb, grounded, clip.fps, clip.cyclic)
        rot = match_positions(skeleton, rot, root, {foot.target: goal}, by_end)
    if clear:
        pos, quat = skeleton.forward(root, rot)
        up = np.zeros_like(root)
        up[:, 2] = lift(pos, quat, range(len(skeleton)))
        root = root + up
        kept = {name: goal + up for name, goal in kept.items()}
    return rot, root, kept


def contact_weight(contact: np.ndarray, fps: float) -> np.ndarray:
    """`(T)` in [0, 1]: 1 where `contact (T)` holds, falling to 0 over `BLEND_S` around it."""
    if not bool(contact.any()):
        return np.zeros(len(contact))
    frames = np.arange(len(contact))
    at = frames[contact]
    k = np.searchsorted(at, frames)
    after = at[np.minimum(k, len(at) - 1)]
    before = at[np.maximum(k - 1, 0)]
    away = np.minimum(np.abs(after - frames), np.abs(frames - before)).astype(float) / fps
    return 0.5 + 0.5 * np.cos(np.pi * np.minimum(away / BLEND_S, 1.0))
