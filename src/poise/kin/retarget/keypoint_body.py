"""Keypoints of one performer as positions of a humanoid's bodies, each frame by itself.

The performer is measured once (`calibrate`). After that a frame needs no other frame: the measured
skeleton is posed in closed form (`motion.points`), its bones' directions pass to the humanoid's skeleton
(`retarget`), and the path is scaled. Contacts are not held, since that needs to know what comes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from poise.body import BodyTable
from poise.errors import PoiseError
from poise.kin.ground import fit_heights
from poise.kin.retarget.common_pose import CommonPose
from poise.kin.retarget.plant import Scale
from poise.kin.retarget.standing import World
from poise.kin.retarget.transfer import passage, transfer
from poise.motion import Clip, Skeleton
from poise.motion.joint_map import JointMap
from poise.motion.keypoints import Keypoints
from poise.motion.points.fit import FitConfig, bones_of, fit_clip
from poise.motion.points.labels import NEEDED, SIDES, find_places
from poise.motion.points.landmarks import complete
from poise.motion.points.measure import Rest, measure, spine_shares, trunk_tracks
from poise.motion.points.solve import Solver, hold_lengths
from poise.spatial import forward_kinematics

#: Rounds in which bones get their length; the error halves about every third.
LENGTH_ROUNDS = 12
#: A rate at which the twist of a limb is not carried over from the frames around.
_NO_MEMORY_FPS = 1e-3


@dataclass(frozen=True, eq=False)
class Trunk:
    """Where the humanoid's shoulders belong, seen from its hips: as the performer's, at its own size.

    Rotations alone cannot tell, since skeletons disagree on how a straight trunk and a lowered shoulder
    turn. long, wide: the humanoid's trunk and shoulders over the performer's. hips, shoulders: its
    bodies, left first. side: `(B, 2)`, what moves with the left or right shoulder: an arm with its own,
    the trunk with both, by its height between hips and shoulders.
    """

    long: float
    wide: float
    hips: tuple[int, int]
    shoulders: tuple[int, int]
    side: Tensor

    @classmethod
    def between(
        cls, table: BodyTable, there: CommonPose, hips: Tensor, shoulders: Tensor, shown: Tensor
    ) -> Trunk | None:
        """From the performer's hips and shoulders, and bodies `shown (T, B, 3)` m of the humanoid in
        some motion; None for a humanoid without arms."""
        rows = table.rows
        at = {(r.kind, r.side): i for i, r in enumerate(rows)}
        if not all((kind, side) in at for kind in ("thigh", "upper_arm") for side in SIDES):
            return None
        thighs = (at["thigh", "left"], at["thigh", "right"])
        arms = (at["upper_arm", "left"], at["upper_arm", "right"])
        line, span = _line(hips, shoulders), shoulders[:, 0] - shoulders[:, 1]
        own_line = _line(shown[:, list(thighs)], shown[:, list(arms)])
        own_span = shown[:, arms[0]] - shown[:, arms[1]]
        height = torch.tensor(there.pos[[r.joint for r in rows], 2])
        low, high = (float(height[list(k)].mean()) for k in (thighs, arms))
        share = ((height - low) / (high - low)).clamp(0.0, 1.0)
        side = torch.zeros(len(rows), 2, dtype=torch.float64)
        for i, row in enumerate(rows):
            above = i
            while above not in arms and rows[above].parent >= 0:
                above = rows[above].parent
            if above in arms:
                side[i, arms.index(above)] = 1.0
            elif row.kind in ("spine", "neck", "head", "clavicle"):
                side[i] = 0.5 * share[i]
        return cls(_ratio(own_line, line), _ratio(own_span, span), thighs, arms, side)

    def put(self, pos: Tensor, hips: Tensor, shoulders: Tensor) -> Tensor:
        """Bodies `(T, B, 3)` m with trunk and arms moved to where the performer has them."""
        middle = pos[:, list(self.hips)].mean(1) + self.long * _line(hips, shoulders)
        half = 0.5 * self.wide * (shoulders[:, 0] - shoulders[:, 1])
        want = torch.stack((middle + half, middle - half), 1)
        return pos + self.side @ (want - pos[:, list(self.shoulders)])


def _line(hips: Tensor, shoulders: Tensor) -> Tensor:
    return shoulders.mean(1) - hips.mean(1)


def _ratio(own: Tensor, other: Tensor) -> float:
    """Median length over median length, without what is missing."""
    return float(own.norm(dim=-1).nanmedian() / other.norm(dim=-1).nanmedian().clamp_min(1e-6))


@dataclass(frozen=True, eq=False)
class PointBody:
    """A measured performer and the humanoid that it moves.

    names: labels of the keypoints. onto, table: the humanoid's skeleton and bodies. rest, share, bones:
    the measured skeleton. joints, here, there, scale: see `retarget`. trunk: where shoulders belong,
    None to leave them. lift: m, how far the humanoid is lifted so that its soles stand on z = 0. notes:
    what was assumed.
    """

    names: tuple[str, ...]
    onto: Skeleton
    table: BodyTable
    places: dict[str, tuple[int, ...]]
    rest: Rest
    share: dict[str, float]
    bones: list[tuple[str, str, float]]
    joints: JointMap
    here: CommonPose
    there: CommonPose
    scale: Scale
    trunk: Trunk | None
    lift: float
    notes: tuple[str, ...]

    @classmethod
    def calibrate(
        cls,
        points: Keypoints,
        onto: Skeleton | Clip,
        table: BodyTable,
        shoulders: Literal["retargeted", "seen"] = "retargeted",
    ) -> PointBody:
        """Measures the performer on some seconds in which all that is needed is seen.

        Args:
            points: a part of the recording, or all of it.
            onto: the humanoid's skeleton, or a clip on it that shows how it stands. table: its bodies.
            shoulders: "retargeted" by rotations, which is what the offline way gives, or "seen", which
                moves trunk and arms to where the performer has them (`Trunk`). That is nearer where
                the keypoints are the humanoid's own joints: 34 mm in place of 71 on a walk of CMU.

        Raises:
            PoiseError: labels that name no body (marker sets are fitted offline), or see `fit_clip`.
        """
        found = find_places(points.names)
        lost = [p.replace("_", " ") for p in NEEDED if p not in found]
        if lost:
            raise PoiseError(
                f"no keypoint is named {lost[0]}, so the points cannot be followed one frame at a time",
                points.source.path or points.name,
                "Convert the file to a clip first, which also works for marker sets",
            )
        config = FitConfig()
        marks = complete(points, config.max_gap_s, config.drop_spikes, config.smooth_hz)
        seen = {p: torch.tensor(t) for p, t in marks.tracks.items() if p in found}
        tracks, spine = trunk_tracks(seen, [])
        share = spine_shares({**seen, "neck": tracks["neck"], "pelvis": tracks["pelvis"]})
        rest = measure(tracks, spine, [])
        clip = fit_clip(points, config)
        world = World.of(clip)
        joints, here, there = passage(clip, onto, world=world)
        scale = Scale.between(world, clip.fps, joints, here, there, None)
        skeleton = onto if isinstance(onto, Skeleton) else onto.skeleton
        body = cls(
            points.names, skeleton, table, {p: found[p] for p in seen}, rest, share, bones_of(rest),
            joints, here, there, scale, None, 0.0, clip.skeleton.source.notes,
        )  # fmt: skip
        places = np.stack([_mean(points.positions, k) for k in body.places.values()], 1)
        pos, quat = body.pose(places)
        whole = ~torch.isnan(pos).flatten(1).any(1)
        fit = fit_heights(table, pos[whole], quat[whole], points.fps)
        trunk = None
        if shoulders == "seen":
            shown = pos[whole]
            if isinstance(onto, Clip):
                shown = torch.tensor(onto.positions()[:, [r.joint for r in table.rows]])
            trunk = Trunk.between(table, there, *body.girdles(places), shown)
        return cls(**{**vars(body), "trunk": trunk, "lift": fit.lift_m})

    def solve(self, positions: np.ndarray) -> np.ndarray:
        """Positions `(T, B, 3)` m of the humanoid's bodies for keypoints `(T, K, 3)` m without gaps."""
        tracks = np.stack([_mean(positions, k) for k in self.places.values()], 1)
        pos = self.pose(tracks)[0]
        if self.trunk is not None:
            pos = self.trunk.put(pos, *self.girdles(tracks))
        return (pos + torch.tensor([0.0, 0.0, self.lift])).numpy()

    def girdles(self, places: np.ndarray) -> tuple[Tensor, Tensor]:
        """The performer's hips and shoulders, `(T, 2, 3)` m, left first."""
        order = list(self.places)
        left, right = (
            torch.tensor(places[:, [order.index(f"{side}_{part}") for side in SIDES]])
            for part in ("hip", "shoulder")
        )
        return left, right

    def pose(self, places: np.ndarray) -> tuple[Tensor, Tensor]:
        """World positions `(T, B, 3)` m and rotations `(T, B, 4)` of the bodies, not yet lifted.

        places: `(T, P, 3)` m, the tracks of `self.places` in order.
        """
        world_in = self._performer(places)
        rot, root = transfer(world_in, self.joints, self.here, self.there, self.scale)
        offsets = torch.tensor(self.onto.offsets)
        pos, quat = forward_kinematics(self.onto.parents, offsets, root, rot)
        rows = [r.joint for r in self.table.rows]
        return pos[:, rows], quat[:, rows]

    def _performer(self, places: np.ndarray) -> World:
        """The measured skeleton in every frame."""
        seen = {p: torch.tensor(places[:, k]) for k, p in enumerate(self.places)}
        tracks, _ = trunk_tracks(seen, [], self.share)
        tracks = hold_lengths(tracks, self.bones, LENGTH_ROUNDS)
        root, rot = Solver(self.rest, tracks, _NO_MEMORY_FPS).run()
        names = list(self.rest.parents)
        parents = tuple(-1 if up is None else names.index(up) for up in self.rest.parents.values())
        offsets = torch.tensor(np.stack([self.rest.offsets[n] for n in names]))
        return World(*forward_kinematics(parents, offsets, root, rot))


def _mean(positions: np.ndarray, columns: tuple[int, ...]) -> np.ndarray:
    """`(T, 3)`, the middle of some keypoints."""
    return positions[:, list(columns)].mean(1)
