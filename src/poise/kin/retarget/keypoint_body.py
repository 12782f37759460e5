"""Keypoints of one performer as positions of a humanoid's bodies, each frame by itself.

The performer is measured once (`calibrate`). After that a frame needs no other frame: the measured
skeleton is posed in closed form (`motion.points`), its bones' directions pass to the humanoid's skeleton
(`retarget`), and the path is scaled. Contacts are not held, since that needs to know what comes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from poise.body import BodyTable
from poise.errors import PoiseError
from poise.kin.ground import fit_heights
from poise.kin.retarget.passage import Passage
from poise.kin.retarget.standing import World
from poise.motion import Clip, Skeleton
from poise.motion.keypoints import Keypoints
from poise.motion.points.fit import FitConfig, bones_of, fit_clip
from poise.motion.points.labels import NEEDED, find_places
from poise.motion.points.landmarks import complete
from poise.motion.points.measure import Rest, measure, spine_shares, trunk_tracks
from poise.motion.points.solve import Solver, hold_lengths
from poise.spatial import forward_kinematics

#: Rounds in which bones get their length; the error halves about every third.
LENGTH_ROUNDS = 12
#: A rate at which the twist of a limb is not carried over from the frames around.
_NO_MEMORY_FPS = 1e-3


@dataclass(frozen=True, eq=False)
class PointBody:
    """A measured performer and the humanoid that it moves.

    names: labels of the keypoints. onto, table: the humanoid's skeleton and bodies. rest, share, bones:
    the measured skeleton. passage: from it to the humanoid. lift: m, how far the humanoid is
    lifted so that its soles stand on z = 0. notes: what was assumed.
    """

    names: tuple[str, ...]
    onto: Skeleton
    table: BodyTable
    places: dict[str, tuple[int, ...]]
    rest: Rest
    share: dict[str, float]
    bones: list[tuple[str, str, float]]
    passage: Passage
    lift: float
    notes: tuple[str, ...]

    @classmethod
    def calibrate(cls, points: Keypoints, onto: Skeleton | Clip, table: BodyTable) -> PointBody:
        """Measures the performer on some seconds in which all that is needed is seen.

        Args:
            points: a part of the recording, or all of it.
            onto: the humanoid's skeleton, or a clip on it that shows how it stands. table: its bodies.

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
        skeleton = onto if isinstance(onto, Skeleton) else onto.skeleton
        body = cls(
            points.names, skeleton, table, {p: found[p] for p in seen}, rest, share, bones_of(rest),
            Passage.between(clip, onto), 0.0, clip.skeleton.source.notes,
        )  # fmt: skip
        places = np.stack([_mean(points.positions, k) for k in body.places.values()], 1)
        pos, quat = body.pose(places)
        whole = ~torch.isnan(pos).flatten(1).any(1)
        fit = fit_heights(table, pos[whole], quat[whole], points.fps)
        return replace(body, lift=fit.lift_m)

    def solve(self, positions: np.ndarray) -> np.ndarray:
        """Positions `(T, B, 3)` m of the humanoid's bodies for keypoints `(T, K, 3)` m without gaps."""
        tracks = np.stack([_mean(positions, k) for k in self.places.values()], 1)
        pos = self.pose(tracks)[0]
        return (pos + torch.tensor([0.0, 0.0, self.lift])).numpy()

    def pose(self, places: np.ndarray) -> tuple[Tensor, Tensor]:
        """World positions `(T, B, 3)` m and rotations `(T, B, 4)` of the bodies, not yet lifted.

        places: `(T, P, 3)` m, the tracks of `self.places` in order.
        """
        return self._onto(self._world(*self._solved(places)))

    def _onto(self, performer: World) -> tuple[Tensor, Tensor]:
        rot, root = self.passage.transfer(performer)
        offsets = torch.tensor(self.onto.offsets)
        pos, quat = forward_kinematics(self.onto.parents, offsets, root, rot)
        rows = [r.joint for r in self.table.rows]
        return pos[:, rows], quat[:, rows]

    def follow(self, positions: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        """The humanoid's bodies `(T, B, 3)` m as `solve` gives them, and what `performer` gives."""
        root, rot = self.performer(positions)
        pos = self._onto(self._world(root, rot))[0] + torch.tensor([0.0, 0.0, self.lift])
        return pos, root, rot

    def performer(self, positions: np.ndarray) -> tuple[Tensor, Tensor]:
        """Root `(T, 3)` m and local rotations `(T, J, 4)` of the measured skeleton, its joints in the
        order of `rest`, for keypoints `(T, K, 3)` m without gaps."""
        return self._solved(np.stack([_mean(positions, k) for k in self.places.values()], 1))

    def _solved(self, places: np.ndarray) -> tuple[Tensor, Tensor]:
        seen = {p: torch.tensor(places[:, k]) for k, p in enumerate(self.places)}
        tracks, _ = trunk_tracks(seen, [], self.share)
        tracks = hold_lengths(tracks, self.bones, LENGTH_ROUNDS)
        return Solver(self.rest, tracks, _NO_MEMORY_FPS).run()

    def _world(self, root: Tensor, rot: Tensor) -> World:
        """The measured skeleton in every frame."""
        names = list(self.rest.parents)
        parents = tuple(-1 if up is None else names.index(up) for up in self.rest.parents.values())
        offsets = torch.tensor(np.stack([self.rest.offsets[n] for n in names]))
        return World(*forward_kinematics(parents, offsets, root, rot))


def _mean(positions: np.ndarray, columns: tuple[int, ...]) -> np.ndarray:
    """`(T, 3)`, the middle of some keypoints."""
    return positions[:, list(columns)].mean(1)
