"""Gaps on a skeleton that the network does not know: filled on the network's own, and brought back.

Of what comes back only the difference counts that the network made: with P the passage to the network's
skeleton and B the passage back, a frame x of the interpolated clip that the network changed to f becomes

    x B(P(x))^-1 B(f)

joint by joint, and likewise for the root's place. Where the network changes nothing, as at keyframes,
the clip is what it was to the last digit, whatever a passage loses; joints that the network's skeleton
lacks, such as fingers, go on from keyframe to keyframe by the shortest arc.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from poise.kin.retarget.passage import Passage
from poise.kin.retarget.standing import World
from poise.motion.clip import Clip
from poise.motion.joint_map import map_joints
from poise.spatial import forward_kinematics, normalize, quat_between, quat_mul, unwrap_quats

Path = tuple[Tensor, Tensor]


@dataclass(frozen=True, eq=False)
class OtherRig:
    """The passage between a clip's skeleton and a network's. A path is root `(T, 3)` m and rot
    `(T, J, 4)` wxyz local."""

    clip: Clip
    example: Clip
    there: Passage
    back: Passage

    @staticmethod
    def between(clip: Clip, example: Clip) -> OtherRig:
        """The passage of `clip` to the skeleton of `example`, which also shows how that one stands.

        Raises:
            PoiseError: a skeleton without pelvis or legs.
        """
        there = Passage.between(clip, example)
        joints = map_joints(example.skeleton, clip.skeleton)
        back = Passage(joints, there.there, there.here, there.scale.inverse())
        return OtherRig(clip, example, there, back)

    def to_model(self, path: Path) -> Path:
        """A path of the clip's skeleton on the network's."""
        return self._passed(self.clip, self.there, path)

    def to_clip(self, path: Path) -> Path:
        """A path of the network's skeleton on the clip's."""
        return self._passed(self.example, self.back, path)

    def changed(self, known: Path, filled: Path) -> Path:
        """`known` on the clip's skeleton with what makes `filled`, on the network's, differ from it."""
        before, after = self.to_clip(self.to_model(known)), self.to_clip(filled)
        root = known[0] + after[0] - before[0]
        turn = quat_between(before[1], after[1])
        return root, unwrap_quats(normalize(quat_mul(known[1], turn)))

    @staticmethod
    def _passed(clip: Clip, passage: Passage, path: Path) -> Path:
        skeleton = clip.skeleton
        world = World(*forward_kinematics(skeleton.parents, torch.tensor(skeleton.offsets), *path))
        rot, root = passage.transfer(world)
        return root, unwrap_quats(normalize(rot))
