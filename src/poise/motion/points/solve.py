"""Rotations of a measured skeleton that follows the tracks of a body."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from poise.motion.points.labels import SIDES
from poise.motion.points.measure import (
    LEFT,
    SIGN,
    TITLE,
    UP,
    Rest,
    chest_frame,
    collars_tell_sides,
    foot_axes,
)
from poise.spatial import (
    axis_angle_to_quat,
    cluster_quat,
    frame_quat,
    normalize,
    quat_conj,
    quat_mul,
    quat_rotate,
    rejected,
    shortest_arc,
    slerp,
    unwrap_quats,
)

#: Time constant (s) over which the twist of a limb is carried on where its hinge shows none.
TWIST_S = 0.05
#: Sine of a bend at which the hinge counts as much as that smoothing.
_BENT = 0.25
#: Cosine of the twist beyond which no joint goes, with the sign changed.
_BEYOND = 0.65
#: How much the foot's direction counts against the knee's hinge (as the sine of a bend).
_FOOT_HINT = 0.12
_ROUNDS = 30


def _vector(v: np.ndarray) -> Tensor:
    return torch.tensor(np.asarray(v), dtype=torch.float64)


class Solver:
    """Poses joint after joint from the root outwards; world frame, `(T, ...)`."""

    def __init__(self, rest: Rest, tracks: dict[str, Tensor], fps: float):
        self.rest, self.tracks, self.fps = rest, tracks, fps
        self.pos: dict[str, Tensor] = {}
        self.quat: dict[str, Tensor] = {}

    def run(self) -> tuple[Tensor, Tensor]:
        """Root positions `(T, 3)` m and local rotations `(T, J, 4)` wxyz in the order of `rest`."""
        self._pelvis()
        self._trunk()
        self._head()
        for side in SIDES:
            self._leg(side)
            self._arm(side)
        local = []
        for name, parent in self.rest.parents.items():
            quat = self.quat[name]
            local.append(quat if parent is None else quat_mul(quat_conj(self.quat[parent]), quat))
        return self.pos["Hips"], unwrap_quats(normalize(torch.stack(local, 1)))

    def _track(self, name: str) -> Tensor:
        return self.tracks[self.rest.points[name]]

    def _place(self, name: str) -> None:
        """Where a joint comes to lie, from its parent's pose."""
        parent = self.rest.parents[name]
        assert parent is not None
        offset = _vector(self.rest.offsets[name]).expand_as(self.pos[parent])
        self.pos[name] = self.pos[parent] + quat_rotate(self.quat[parent], offset)

    def _aim(self, name: str, child: str) -> Tensor:
        """The smallest turn from the parent's pose that points a bone at its child's track."""
        parent = self.rest.parents[name]
        assert parent is not None
        bone = _vector(self.rest.offsets[child]).expand_as(self.pos[name])
        now = quat_rotate(self.quat[parent], bone)
        return quat_mul(shortest_arc(now, self._track(child) - self.pos[name]), self.quat[parent])

    def _pelvis(self) -> None:
        """Root pose: the turn and place that fit hips and first spine joint best, in closed form."""
        names = ["LeftUpLeg", "RightUpLeg", self.rest.spine[0]]
        template = torch.stack([_vector(self.rest.offsets[n]) for n in names])
        seen = torch.stack([self._track(n) for n in names], 1)
        weights = torch.tensor([1.0, 1.0, 0.5], dtype=torch.float64)
        weights = weights / weights.sum()
        middle, centre = weights @ template, (weights[:, None] * seen).sum(1)
        quat = cluster_quat(template - middle, seen - centre[:, None], weights)
        self.quat["Hips"] = quat
        # The legs hang on the pelvis: the middle of the hips is met exactly.
        hips = (template[0] + template[1]) / 2
        self.pos["Hips"] = (seen[:, 0] + seen[:, 1]) / 2 - quat_rotate(quat, hips.expand_as(centre))

    def _trunk(self) -> None:
        """The spine points from joint to joint and shares the twist between pelvis and chest."""
        spine = self.rest.spine
        lateral = _vector(LEFT).expand_as(self.pos["Hips"])
        chest = chest_frame(self.tracks, self.rest.points[spine[-1]])
        for i, name in enumerate(spine):
            self._place(name)
            if name == spine[-1]:
                self.quat[name] = self._chest(name)
                break
            up = self._track(spine[i + 1]) - self.pos[name]
            share = torch.full_like(up[:, 0], (i + 1) / len(spine))
            between = slerp(self.quat["Hips"], chest, share)
            x = rejected(quat_rotate(between, lateral), normalize(up))
            self.quat[name] = frame_quat(x, up)

    def _chest(self, name: str) -> Tensor:
        """The chest's rotation: neck and collars (or shoulders, which count less) as one cluster."""
        own = collars_tell_sides(self.tracks)
        names, template = ["Neck"], [self.rest.offsets["Neck"]]
        for side in SIDES:
            collar = self.rest.offsets[f"{TITLE[side]}Shoulder"]
            reach = 0.0 if own else self.rest.offsets[f"{TITLE[side]}Arm"]
            names.append(f"{TITLE[side]}{'Shoulder' if own else 'Arm'}")
            template.append(collar + reach)
        seen = torch.stack([self._track(n) - self.pos[name] for n in names], 1)
        weights = torch.tensor([1.0, 1.0, 1.0] if own else [1.0, 0.5, 0.5], dtype=torch.float64)
        return cluster_quat(torch.stack([_vector(v) for v in template]), seen, weights)

    def _head(self) -> None:
        self._place("Neck")
        self.quat["Neck"] = self._aim("Neck", "Head")
        self._place("Head")
        tracks, up = self.tracks, self.tracks.get("head_top", self.tracks["head"]) - self.tracks["neck"]
        pairs = [(f"left_{p}", f"right_{p}") for p in ("ear", "eye")]
        pair = next((p for p in pairs if p[0] in tracks and p[1] in tracks), None)
        if pair is not None:
            left = tracks[pair[0]] - tracks[pair[1]]
        elif "face" in tracks:
            left = torch.linalg.cross(up, tracks["face"] - tracks["neck"], dim=-1)
        else:
            self.quat["Head"] = self.quat["Neck"]
            return
        self.quat["Head"] = frame_quat(rejected(left, normalize(up)), up)

    def _leg(self, side: str) -> None:
        thigh, shin, foot = (f"{TITLE[side]}{part}" for part in ("UpLeg", "Leg", "Foot"))
        hint = None
        if self.rest.foot[side]:
            hint = _FOOT_HINT * foot_axes(self.tracks, side)[1]
        self._hinged(thigh, shin, foot, _vector(LEFT), hint)
        self._foot(side, foot)

    def _arm(self, side: str) -> None:
        name = TITLE[side]
        collar, upper, lower, hand = (f"{name}{p}" for p in ("Shoulder", "Arm", "ForeArm", "Hand"))
        self._place(collar)
        self.quat[collar] = self._aim(collar, upper)
        # A forearm bends forward: from outwards (+-X) to the front (-Y), about -+Z.
        self._hinged(upper, lower, hand, -SIGN[side] * _vector(UP), None)
        self._place(hand)
        self.quat[hand] = self.quat[lower]
        if f"{side}_hand" in self.tracks:
            now = quat_rotate(self.quat[lower], _vector(self.rest.tips[hand]).expand_as(self.pos[hand]))
            seen = self.tracks[f"{side}_hand"] - self.tracks[f"{side}_wrist"]
            self.quat[hand] = quat_mul(shortest_arc(now, seen), self.quat[lower])

    def _hinged(self, upper: str, lower: str, end: str, axis: Tensor, hint: Tensor | None) -> None:
        """Two bones with a hinge of the rest axis `axis (3)` between them.

        The upper one points at the hinge's track, and twists so that the bend lies about the hinge's
        axis as far as there is a bend (`hint` adds to it); the lower one goes on by the smallest turn.
        """
        self._place(upper)
        swing = self._aim(upper, lower)
        bone = self._track(lower) - self.pos[upper]
        d1 = normalize(bone)
        knee = self.pos[upper] + d1 * float(np.linalg.norm(self.rest.offsets[lower]))
        d2 = normalize(self._track(end) - knee)
        # The bend's axis times the sine of the bend.
        hinge = torch.linalg.cross(d1, d2)
        if hint is not None:
            hinge = hinge + rejected(hint, d1)
        zero = quat_rotate(swing, axis.expand_as(d1))
        quarter = torch.linalg.cross(d1, zero)
        shown = torch.stack(((hinge * zero).sum(-1), (hinge * quarter).sum(-1)), -1)
        angle = steady_twist(shown, self.fps)
        self.quat[upper] = quat_mul(axis_angle_to_quat(d1, angle), swing)
        self._place(lower)
        self.quat[lower] = self._aim(lower, end)

    def _foot(self, side: str, foot: str) -> None:
        self._place(foot)
        cluster, shin = self.rest.foot[side], self.quat[f"{TITLE[side]}Leg"]
        toe = f"{TITLE[side]}ToeBase"
        if not cluster:
            self.quat[foot] = shin
            return
        # Everything is seen from the ankle's own track, so that an error of the leg does not tilt the
        # foot.
        ankle = self.tracks[f"{side}_ankle"]
        left = foot_axes(self.tracks, side)[1]
        places = list(cluster)
        template = torch.stack([*(_vector(cluster[p]) for p in places), 0.1 * _vector(LEFT)])
        seen = torch.stack([*(self.tracks[f"{side}_{p}"] - ankle for p in places), 0.1 * left], 1)
        weights = torch.ones(len(places) + 1, dtype=torch.float64)
        weights[-1] = 0.2
        self.quat[foot] = cluster_quat(template, seen, weights)
        self._place(toe)
        self.quat[toe] = self.quat[foot]


def steady_twist(shown: Tensor, fps: float) -> Tensor:
    """Twist angles `(T)` from observations `(T, 2)`: cosine and sine, as long as they can be trusted.

    Minimises sum w |z_t - o_t|^2 + (TWIST_S fps)^2 |z_t+1 - z_t|^2 + e |z_t - 1|^2 over complex z, with
    o the direction of the observation and w the fourth power of its length in units of a bend at which
    it counts fully. Where no bend shows the twist, it passes from one observation to the next; without
    any, it is zero. Complex numbers know no jump from pi to -pi.
    """
    length = shown.norm(dim=-1)
    weight = (length / _BENT).pow(4).clamp(max=1e3)
    unit = shown / length.clamp_min(1e-12).unsqueeze(-1)
    # No shoulder or hip twists beyond some 130 degrees: there the bend is a noisy, straight limb's.
    weight = weight * ((unit[..., 0] + _BEYOND) / _BEYOND).clamp(0.0, 1.0)
    prior, between = 1e-6, (TWIST_S * fps) ** 2
    right = weight.unsqueeze(-1) * unit
    right = right + prior * torch.tensor([1.0, 0.0], dtype=shown.dtype)
    diagonal = weight + prior + between * 2.0
    diagonal[0], diagonal[-1] = diagonal[0] - between, diagonal[-1] - between
    # The upper band; its first number stands outside the matrix, and a single frame has none.
    bands = np.stack((np.full(len(diagonal), -between), diagonal.numpy()))
    from scipy.linalg import solveh_banded

    z = solveh_banded(bands[-len(diagonal) :], right.numpy())
    return torch.atan2(torch.tensor(z[:, 1]), torch.tensor(z[:, 0]))


def hold_lengths(
    tracks: dict[str, Tensor], bones: list[tuple[str, str, float]], rounds: int = _ROUNDS
) -> dict[str, Tensor]:
    """The tracks moved as little as needed so that each bone `(place, place, m)` has its length.

    Each round moves both ends of every bone by half of its error (position-based dynamics, Mueller et
    al. 2007), which spreads the error of a limb over its joints instead of piling it up at the end.
    """
    out = dict(tracks)
    for _ in range(rounds):
        for a, b, length in bones:
            line = out[b] - out[a]
            now = line.norm(dim=-1, keepdim=True).clamp_min(1e-9)
            move = line * (0.5 * (now - length) / now)
            out[a], out[b] = out[a] + move, out[b] - move
    return out
