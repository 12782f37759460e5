"""Hands that keep their place on another skeleton: over the floor, from the hips, on what they touch."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from poise.kinematics.limbs import Limb
from poise.kinematics.retargeting.passage import Retargeter, hip_middle
from poise.kinematics.retargeting.standing import ClipWorld
from poise.motion.roles import SIDES
from poise.motion.rotations import quat_conj, quat_mul, quat_to_rotvec, rotvec_to_quat
from poise.motion.skeleton import Skeleton
from poise.motion.smoothing import eased, gaussian, smoothstep
from poise.motion.vectors import norm

#: Distance of a wrist from the middle of a part of the body, by the height of the hips, up to which the
#: hand goes with that part, and from which on it does not at all.
TOUCHES, APART = 0.15, 0.4
#: Distance within which all parts are equally near.
_INSIDE = 0.05
#: A head's height over its joint, by the height of the hips.
_CROWN = 0.2
#: Deviation (s) of the bell by which the way of a hand beside what it goes with is smoothed.
_CALM_S = 0.05
#: Up to this (Hz) the elbow's turn follows what a wrist's place asks for.
_ELBOW_HZ = 4.0
#: Share of a bone that a wrist may be off, below which the turn stays as it is.
_SLOW = 1e-3
#: So many times more the turn counts where a hand is on the floor.
_HELD = 1e3
#: Bend (rad) of an elbow that arms do not exceed, unless the source's do.
FOLDED = math.radians(150)


#: Both ends of a line through a part of the body, each `(T, 3)` m.
_Line = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class HandPlaces:
    """The places of hands on another skeleton.

    A wrist is to be where the source's is, at the target's size: x' = c + k (x - c) as the path of the
    hips and the steps have it. So it keeps its place from the hips, over the floor, from a prop of that
    size, and hands that meet do so. Trunks, heads and arms differ in more than size: let d_p be by how
    much the target has a point of such a part elsewhere than scaled. A hand near it goes with it,

        x'' = x' + max_p w_p (sum_p w_p r_p^-4 d_p) / (sum_p w_p r_p^-4),

    w_p falling from 1 at `TOUCHES` to 0 at `APART` by the distance r_p of the source's wrist from the
    part; the nearest part counts most, and the shift is smoothed over time.

    passage: from the source. world: of the source's joints. fps, cyclic: of the clip.
    """

    passage: Retargeter
    world: ClipWorld
    fps: float
    cyclic: bool = False

    def of(self, pair: tuple[int, int], side: str, pos: np.ndarray, grounded: np.ndarray) -> np.ndarray:
        """Places `(T, 3)` m of a wrist.

        Args:
            pair: its joint in source and target. side: of the body.
            pos: `(T, J, 3)` m, of the target's joints.
            grounded: `(T)` in [0, 1], how much the hand is on the floor and goes with nothing else.
        """
        here, scale = self.passage.here, self.passage.scale
        wrist = self.world.pos[:, pair[0]]
        most, total, moved = np.zeros(len(wrist)), np.zeros(len(wrist)), np.zeros_like(wrist)
        for (a, b), (a_there, b_there) in self._parts(side, pos):
            line = b - a
            share = ((wrist - a) * line).sum(-1) / np.maximum((line * line).sum(-1), 1e-12)
            share = np.clip(share, 0.0, 1.0)[:, None]
            far = norm(wrist - a - share * line) / here.hip_height
            weight = smoothstep(np.clip((APART - far) / (APART - TOUCHES), 0.0, 1.0))
            off = (1 - share) * (a_there - scale.place(a)) + share * (b_there - scale.place(b))
            near = weight / np.maximum(far, _INSIDE) ** 4
            most = np.maximum(most, weight)
            total += near
            moved += near[:, None] * off
        moved *= (most / np.maximum(total, 1e-9))[:, None]
        moved = _calm(moved, _CALM_S * self.fps, self.cyclic)
        return scale.place(wrist) + (1 - grounded)[:, None] * moved

    def _parts(self, side: str, pos: np.ndarray) -> list[tuple[_Line, _Line]]:
        """Lines through the parts that a hand of `side` may touch, in source and target."""
        joints, here = self.passage.joints, self.passage.here
        nodes: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        for s in SIDES:
            for kind in ("thigh", "shin", "foot", "upper_arm", "forearm", "hand"):
                pair = joints.limb_pair(f"{s}_{kind}")
                if pair is not None:
                    nodes[f"{s}_{kind}"] = self.world.pos[:, pair[0]], pos[:, pair[1]]
            if (name := f"{s}_hand") in nodes:
                # Two hands would follow each other anywhere.
                nodes[name] = nodes[name][0], self.passage.scale.place(nodes[name][0])
        nodes["hips"] = hip_middle(joints, self.world.pos, 0), hip_middle(joints, pos, 1)
        arms = [nodes[name] for s in SIDES if (name := f"{s}_upper_arm") in nodes]
        if len(arms) == 2:
            nodes["chest"] = (arms[0][0] + arms[1][0]) / 2, (arms[0][1] + arms[1][1]) / 2
        head = joints.limb_pair("head")
        if head is not None and "chest" in nodes:
            nodes["head"] = low = self.world.pos[:, head[0]], pos[:, head[1]]
            up = low[0] - nodes["chest"][0]
            up = up / np.maximum(norm(up, keepdims=True), 1e-9) * _CROWN * here.hip_height
            nodes["crown"] = low[0] + up, low[1] + up * self.passage.scale.factor
        other = SIDES[1 - SIDES.index(side)]
        lines = [
            *(("hips", "chest"), ("left_upper_arm", "right_upper_arm"), ("left_thigh", "right_thigh")),
            *(("chest", "head"), ("head", "crown")),
            *((f"{s}_thigh", f"{s}_shin") for s in SIDES),
            *((f"{s}_shin", f"{s}_foot") for s in SIDES),
            *((f"{other}_upper_arm", f"{other}_forearm"), (f"{other}_forearm", f"{other}_hand")),
        ]
        ends = [(nodes[a], nodes[b]) for a, b in lines if a in nodes and b in nodes]
        return [((a[0], b[0]), (a[1], b[1])) for a, b in ends]


def calm_elbow(
    skeleton: Skeleton,
    before: np.ndarray,
    rot: np.ndarray,
    root: np.ndarray,
    limb: Limb,
    grounded: np.ndarray,
    fps: float,
    cyclic: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Rotations `(T, J, 4)` wxyz whose elbow turns other than in `before` by a smooth path, and places
    `(T, 3)` m for the wrist, as far from the shoulder as that elbow has it and in the same direction.

    A bend moves the wrist of an arm (u, v) that spans d by |u x v| / d from the shoulder: the straighter
    the arm, the less. So the path of the turn is followed as much as it moves the wrist (`eased`); near
    full reach, where little way takes much bend, it is not. A hand that is `grounded (T)` stays there,
    and a turn without anything quick stays as it is.
    """
    pos = skeleton.forward(root, rot)[0]
    shoulder, elbow, wrist = (pos[:, j] for j in (limb.root, limb.mid, limb.end))
    u, v, d = elbow - shoulder, wrist - elbow, wrist - shoulder
    span = np.maximum(norm(d, keepdims=True), 1e-9)
    slope = norm(np.cross(u, v)) / span[:, 0] / np.maximum(np.minimum(norm(u), norm(v)), 1e-9)
    turn = quat_to_rotvec(quat_mul(quat_conj(before[:, limb.mid]), rot[:, limb.mid]))
    out = rot.copy()
    weight = np.minimum(slope, 1.0) ** 2 + _HELD * grounded
    if cyclic and len(turn) > 1:
        # The last frame of a cycle is the first one again: the middle one of three rounds.
        once = len(turn) - 1
        rounds, weights = np.tile(turn[:-1], (3, 1)), np.tile(weight[:-1], 3)
        smooth = eased(rounds, weights, fps, _ELBOW_HZ)[once : 2 * once + 1]
    else:
        smooth = eased(turn, weight, fps, _ELBOW_HZ)
    if float((slope * norm(smooth - turn)).max()) < _SLOW:
        # Nothing quick is asked for.
        return rot, wrist
    calm = rotvec_to_quat(smooth)
    out[:, limb.mid] = quat_mul(before[:, limb.mid], calm)
    there = skeleton.forward(root, out)[0][:, limb.end]
    return out, shoulder + d / span * norm(there - shoulder, keepdims=True)


def _calm(path: np.ndarray, sigma: float, cyclic: bool) -> np.ndarray:
    """The mean of a path `(T, 3)` near each frame, weighted by a bell of `sigma` frames."""
    # The last frame of a cycle is the first one again.
    once = path[:-1] if cyclic and len(path) > 1 else path
    window = gaussian(sigma)
    reach = len(window) // 2
    padded = np.pad(once, ((reach, reach), (0, 0)), mode="wrap" if cyclic else "edge")
    out = np.stack([np.convolve(column, window, "valid") for column in padded.T], -1)
    return out if len(once) == len(path) else np.concatenate((out, out[:1]))
