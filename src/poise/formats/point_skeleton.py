"""A skeleton measured on the tracks of a body, and its rotations that follow them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from poise.formats.markers import SIDES
from poise.formats.text import listed
from poise.motion.rotations import (
    axis_angle_to_quat,
    cluster_quat,
    frame_quat,
    normalize,
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_rotate_inv,
    rejected,
    shortest_arc,
    slerp,
    unwrap_quats,
)
from poise.motion.vectors import cross, lower_median, norm

# The rest pose stands in the T-pose, faces -Y and has its left at +X.
LEFT, BACK, UP = np.eye(3)
SIGN = {"left": 1.0, "right": -1.0}
TITLE = {"left": "Left", "right": "Right"}

# Shares for what keypoints do not show. Spine joints along the line from hips to neck; the neck above
# the shoulders in trunk lengths; the collar's inner end in half shoulder widths; the ball of the foot
# along it.
_SPINE_GAP = 0.2
_SPINE_SHARES, _NECK_SHARE, _COLLAR_SHARE, _BALL_SHARE = (0.25, 0.55), 0.08, 0.2, 0.72
# Shares of the standing height: leg from hip to ankle; neck to head joint; ball of the foot below the
# ankle.
_LEG_SHARE, _HEAD_SHARE, _BALL_DROP = 0.491, 0.065, 0.027
_HEAD_OF_TOP = 0.35
# Collars that are less apart than this share of the shoulders' distance lie in one place.
_ONE_PLACE = 0.05
_ASYMMETRY = 0.05


@dataclass
class Rest:
    """The skeleton while it is measured: joints in order, and where each one's track is.

    offsets: joint -> m in its parent's frame at rest. tips: joint -> tip in its frame.
    points: joint -> place of the body with the track that it follows.
    foot: side -> cluster of the foot, place -> m from the ankle.
    """

    parents: dict[str, str | None] = field(default_factory=dict)
    offsets: dict[str, np.ndarray] = field(default_factory=dict)
    tips: dict[str, np.ndarray] = field(default_factory=dict)
    points: dict[str, str] = field(default_factory=dict)
    foot: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    spine: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, name: str, parent: str | None, offset: np.ndarray, place: str) -> None:
        """Adds a joint that follows the track of `place`."""
        self.parents[name], self.offsets[name], self.points[name] = parent, np.asarray(offset), place


def spine_shares(tracks: dict[str, np.ndarray]) -> dict[str, float]:
    """How far up each of the spine's places lies on the way from the pelvis to the neck, by median."""
    line = tracks["neck"] - tracks["pelvis"]
    square = np.maximum(np.square(line).sum(-1), 1e-12)
    return {
        place: float(lower_median(((track - tracks["pelvis"]) * line).sum(-1) / square))
        for place, track in tracks.items()
        if place.startswith("spine")
    }


def trunk_tracks(
    tracks: dict[str, np.ndarray], notes: list[str], share: dict[str, float] | None = None
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The tracks with pelvis, spine, neck and head joint, interpolated where they were not measured, and
    the spine's places from below.

    Interpolated: the pelvis between the hips, the neck above the shoulders, the spine on the line
    between them, the head joint on the way to the top of the head. share: see `spine_shares`, where it
    is known from other frames of the same body.
    """
    out = {p: t for p, t in tracks.items() if not p.startswith("spine")}
    made: list[str] = []
    hips = (out["left_hip"] + out["right_hip"]) / 2
    shoulders = (out["left_shoulder"] + out["right_shoulder"]) / 2
    if "pelvis" not in out:
        out["pelvis"] = hips
    if "neck" not in out:
        out["neck"] = shoulders + _NECK_SHARE * (shoulders - hips)
        made.append("neck")
    if share is None:
        share = spine_shares({**tracks, **out})
    spine: list[str] = []
    for place in sorted(share, key=lambda p: share[p]):
        if 0.03 < share[place] < 0.93 and (not spine or share[place] - share[spine[-1]] > 0.03):
            out[place] = tracks[place]
            spine.append(place)
    seen, top = len(spine), share[spine[-1]] if spine else 0.0
    for made_share in _SPINE_SHARES:
        if made_share > top + _SPINE_GAP:
            # Between what is seen below and the neck, so that a seen pelvis bends against the rest.
            below = out[spine[-1]] if spine else out["pelvis"]
            out[f"spine at {made_share}"] = below + (made_share - top) / (1 - top) * (
                out["neck"] - below
            )
            spine.append(f"spine at {made_share}")
            top = made_share
    if len(spine) > seen:
        made.append("upper spine" if seen else "spine")
    if "head" not in out:
        out["head"] = _head(out)
        made.append("head joint")
    if made:
        notes.append(
            f"No keypoint shows the {', '.join(made)}: interpolated by the usual proportions of a body"
        )
    return out, spine


def _head(tracks: dict[str, np.ndarray]) -> np.ndarray:
    neck = tracks["neck"]
    if "head_top" in tracks:
        return neck + _HEAD_OF_TOP * (tracks["head_top"] - neck)
    sides = [("left_ear", "right_ear"), ("left_eye", "right_eye")]
    for left, right in sides:
        if left in tracks and right in tracks:
            return (tracks[left] + tracks[right]) / 2
    trunk = neck - tracks["pelvis"]
    length = _HEAD_SHARE / _LEG_SHARE * _leg(tracks)
    return neck + length * trunk / np.maximum(norm(trunk, keepdims=True), 1e-9)


def _leg(tracks: dict[str, np.ndarray]) -> float:
    """Median length of a leg from hip to ankle along its bones, m."""
    return float(
        np.mean([_median(tracks, f"{s}_{a}", f"{s}_{b}") for s in SIDES for a, b in
                 (("hip", "knee"), ("knee", "ankle"))]) * 2
    )  # fmt: skip


def _median(tracks: dict[str, np.ndarray], a: str, b: str) -> float:
    """Median distance of two places over the frames, m."""
    return float(lower_median(norm(tracks[a] - tracks[b])))


def _local(frame: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Median of the vectors `(T, 3)` as seen from frames `(T, 4)`, in rest axes."""
    return lower_median(quat_rotate_inv(frame, v), 0)


def pelvis_frame(tracks: dict[str, np.ndarray], spine: str) -> np.ndarray:
    """wxyz `(T, 4)`: x from right to left hip, z towards the spine."""
    hips = (tracks["left_hip"] + tracks["right_hip"]) / 2
    return frame_quat(tracks["left_hip"] - tracks["right_hip"], tracks[spine] - hips)


def collars_tell_sides(tracks: dict[str, np.ndarray]) -> bool:
    """Whether there are collars, and not both in one place, as where they hang on the neck."""
    if not all(f"{s}_collar" in tracks for s in SIDES):
        return False
    apart, width = (_median(tracks, f"left_{p}", f"right_{p}") for p in ("collar", "shoulder"))
    return apart > _ONE_PLACE * width


def chest_frame(tracks: dict[str, np.ndarray], chest: str) -> np.ndarray:
    """wxyz `(T, 4)`: z from the chest joint to the neck, x from right to left shoulder."""
    up = tracks["neck"] - tracks[chest]
    part = "collar" if collars_tell_sides(tracks) else "shoulder"
    x = rejected(tracks[f"left_{part}"] - tracks[f"right_{part}"], up / norm(up, keepdims=True))
    return frame_quat(x, up)


def foot_axes(tracks: dict[str, np.ndarray], side: str) -> tuple[np.ndarray, np.ndarray]:
    """Forward along the sole and towards the left `(T, 3)`, unit length up to rounding.

    Forward is from heel to toes, or from the ankle where no heel is seen; left is square to it and to
    the shin.
    """
    ankle = tracks[f"{side}_ankle"]
    front = tracks[f"{side}_toe_tip" if f"{side}_toe_tip" in tracks else f"{side}_toe"]
    forward = front - tracks.get(f"{side}_heel", ankle)
    left = cross(tracks[f"{side}_knee"] - ankle, forward)
    unit = forward / np.maximum(norm(forward, keepdims=True), 1e-9)
    return unit, left / np.maximum(norm(left, keepdims=True), 1e-9)


def measure(tracks: dict[str, np.ndarray], spine: list[str], notes: list[str]) -> Rest:
    """The rest skeleton of completed tracks (`trunk_tracks`): medians over all frames, left as right."""
    rest = Rest(notes=notes)
    rest.add("Hips", None, np.zeros(3), "pelvis")
    frame = pelvis_frame(tracks, spine[0])
    pelvis = tracks["pelvis"]
    hips = _mirrored({s: _local(frame, tracks[f"{s}_hip"] - pelvis) for s in SIDES})
    for side in SIDES:
        _leg_joints(rest, tracks, side, hips[side])
    above, parent = pelvis, "Hips"
    for i, place in enumerate(spine):
        if i == 0:
            offset = _local(frame, tracks[place] - above) * (0.0, 1.0, 1.0)
        else:
            offset = UP * _median(tracks, spine[i - 1], place)
        name = "Spine" + (str(i) if i else "")
        rest.add(name, parent, offset, place)
        rest.spine.append(name)
        above, parent = tracks[place], name
    rest.add("Neck", parent, UP * _median(tracks, spine[-1], "neck"), "neck")
    rest.add("Head", "Neck", UP * _median(tracks, "neck", "head"), "head")
    if "head_top" in tracks:
        rest.tips["Head"] = UP * _median(tracks, "head", "head_top")
    _arm_joints(rest, tracks, spine[-1], parent)
    _note_asymmetry(rest, tracks)
    return rest


def _mirrored(by_side: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Left and right places that mirror each other: the mean of one and the other's image."""
    image = np.array([-1.0, 1.0, 1.0])
    left = (by_side["left"] + image * by_side["right"]) / 2
    return {"left": left, "right": image * left}


def _both(tracks: dict[str, np.ndarray], a: str, b: str) -> float:
    """The length of a bone of both sides: the mean of their medians, m."""
    return float(np.mean([_median(tracks, f"{s}_{a}", f"{s}_{b}") for s in SIDES]))


def _leg_joints(rest: Rest, tracks: dict[str, np.ndarray], side: str, hip: np.ndarray) -> None:
    name = TITLE[side]
    rest.add(f"{name}UpLeg", "Hips", hip, f"{side}_hip")
    rest.add(f"{name}Leg", f"{name}UpLeg", -UP * _both(tracks, "hip", "knee"), f"{side}_knee")
    rest.add(f"{name}Foot", f"{name}Leg", -UP * _both(tracks, "knee", "ankle"), f"{side}_ankle")
    clusters = {s: _foot_cluster(tracks, s) for s in SIDES}
    shared = set(clusters["left"]) & set(clusters["right"])
    cluster = clusters[side]
    for part in shared:
        cluster[part] = _mirrored({s: clusters[s][part] for s in SIDES})[side]
    rest.foot[side] = cluster
    if not cluster:
        rest.tips[f"{name}Foot"] = _sloping(0.09 / _LEG_SHARE * _leg(tracks), _leg(tracks))
        if side == "left":
            rest.notes.append("No keypoint shows a toe: the feet follow the shins at a right angle")
        return
    ball, tip = cluster.get("toe"), cluster.get("toe_tip")
    if ball is None:
        assert tip is not None
        start = cluster.get("heel", np.zeros(3))
        ball = start + _BALL_SHARE * (tip - start)
        place = f"{side}_ball"
        tracks[place] = _ball_track(tracks, side)
    else:
        place = f"{side}_toe"
    rest.add(f"{name}ToeBase", f"{name}Foot", ball, place)
    if tip is not None:
        rest.tips[f"{name}ToeBase"] = tip - ball


def _ball_track(tracks: dict[str, np.ndarray], side: str) -> np.ndarray:
    start = tracks.get(f"{side}_heel", tracks[f"{side}_ankle"])
    return start + _BALL_SHARE * (tracks[f"{side}_toe_tip"] - start)


def _foot_cluster(tracks: dict[str, np.ndarray], side: str) -> dict[str, np.ndarray]:
    """Places of toe, toe tip and heel as seen from the ankle in a foot that stands, m.

    With a heel the sole's line is level. Without, the ball lies a usual height below the ankle.
    """
    parts = [p for p in ("toe", "toe_tip", "heel") if f"{side}_{p}" in tracks]
    if not {"toe", "toe_tip"} & set(parts):
        return {}
    ankle = tracks[f"{side}_ankle"]
    if "heel" in parts:
        forward, left = foot_axes(tracks, side)
        frame = frame_quat(left, cross(forward, left))
        return {p: _local(frame, tracks[f"{side}_{p}"] - ankle) for p in parts}
    leg = _leg(tracks)
    return {p: _sloping(_median(tracks, f"{side}_ankle", f"{side}_{p}"), leg) for p in parts}


def _sloping(length: float, leg: float) -> np.ndarray:
    """A vector of `length` from the ankle to the ball of a standing foot."""
    drop = min(_BALL_DROP / _LEG_SHARE * leg, 0.7 * length)
    return -BACK * np.sqrt(length**2 - drop**2) - UP * drop


def _arm_joints(rest: Rest, tracks: dict[str, np.ndarray], chest: str, parent: str) -> None:
    frame, at = chest_frame(tracks, chest), tracks[chest]
    own = all(f"{s}_collar" in tracks for s in SIDES)
    part = "collar" if own else "shoulder"
    places = _mirrored({s: _local(frame, tracks[f"{s}_{part}"] - at) for s in SIDES})
    length = _both(tracks, "collar", "shoulder") if own else (1 - _COLLAR_SHARE) * places["left"][0]
    for side in SIDES:
        name, out = TITLE[side], LEFT * SIGN[side]
        collar = places[side] if own else places[side] * (_COLLAR_SHARE, 1.0, 1.0)
        rest.add(f"{name}Shoulder", parent, collar, f"{side}_collar" if own else "")
        rest.add(f"{name}Arm", f"{name}Shoulder", out * length, f"{side}_shoulder")
        upper = _both(tracks, "shoulder", "elbow")
        rest.add(f"{name}ForeArm", f"{name}Arm", out * upper, f"{side}_elbow")
        lower = _both(tracks, "elbow", "wrist")
        rest.add(f"{name}Hand", f"{name}ForeArm", out * lower, f"{side}_wrist")
        if f"{side}_hand" in tracks:
            rest.tips[f"{name}Hand"] = out * _median(tracks, f"{side}_wrist", f"{side}_hand")


def _note_asymmetry(rest: Rest, tracks: dict[str, np.ndarray]) -> None:
    odd = []
    bones = (("hip", "knee", "thigh"), ("knee", "ankle", "shin"), ("shoulder", "elbow", "upper arm"))
    for a, b, name in (*bones, ("elbow", "wrist", "forearm")):
        left, right = (_median(tracks, f"{s}_{a}", f"{s}_{b}") for s in SIDES)
        if abs(left - right) > _ASYMMETRY * max(left, right):
            odd.append(f"{name} {left * 1e3:.0f} and {right * 1e3:.0f} mm")
    if odd:
        rest.notes.append(f"Left and right differ and were averaged: {listed(odd)}")


#: Time constant (s) over which the twist of a limb is carried on where its hinge shows none.
TWIST_S = 0.05
#: Sine of a bend at which the hinge counts as much as that smoothing.
_BENT = 0.25
#: Cosine of the twist beyond which no joint goes, with the sign changed.
_BEYOND = 0.65
#: How much the foot's direction counts against the knee's hinge (as the sine of a bend).
_FOOT_HINT = 0.12
_ROUNDS = 30


def _vector(v: np.ndarray) -> np.ndarray:
    return np.asarray(v, dtype=float)


class Solver:
    """Poses joint after joint from the root outwards; world frame, `(T, ...)`."""

    def __init__(self, rest: Rest, tracks: dict[str, np.ndarray], fps: float):
        self.rest, self.tracks, self.fps = rest, tracks, fps
        self.pos: dict[str, np.ndarray] = {}
        self.quat: dict[str, np.ndarray] = {}

    def run(self) -> tuple[np.ndarray, np.ndarray]:
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
        return self.pos["Hips"], unwrap_quats(normalize(np.stack(local, 1)))

    def _track(self, name: str) -> np.ndarray:
        return self.tracks[self.rest.points[name]]

    def _place(self, name: str) -> None:
        """Where a joint comes to lie, from its parent's pose."""
        parent = self.rest.parents[name]
        assert parent is not None
        offset = np.broadcast_to(_vector(self.rest.offsets[name]), self.pos[parent].shape)
        self.pos[name] = self.pos[parent] + quat_rotate(self.quat[parent], offset)

    def _aim(self, name: str, child: str) -> np.ndarray:
        """The smallest turn from the parent's pose that points a bone at its child's track."""
        parent = self.rest.parents[name]
        assert parent is not None
        bone = np.broadcast_to(_vector(self.rest.offsets[child]), self.pos[name].shape)
        now = quat_rotate(self.quat[parent], bone)
        return quat_mul(shortest_arc(now, self._track(child) - self.pos[name]), self.quat[parent])

    def _pelvis(self) -> None:
        """Root pose: the turn and place that fit hips and first spine joint best, in closed form."""
        names = ["LeftUpLeg", "RightUpLeg", self.rest.spine[0]]
        template = np.stack([_vector(self.rest.offsets[n]) for n in names])
        seen = np.stack([self._track(n) for n in names], 1)
        weights = np.array([1.0, 1.0, 0.5], dtype=float)
        weights = weights / weights.sum()
        middle, centre = weights @ template, (weights[:, None] * seen).sum(1)
        quat = cluster_quat(template - middle, seen - centre[:, None], weights)
        self.quat["Hips"] = quat
        # The legs hang on the pelvis: the middle of the hips is met exactly.
        hips = (template[0] + template[1]) / 2
        self.pos["Hips"] = (seen[:, 0] + seen[:, 1]) / 2 - quat_rotate(
            quat, np.broadcast_to(hips, centre.shape)
        )

    def _trunk(self) -> None:
        """The spine points from joint to joint and shares the twist between pelvis and chest."""
        spine = self.rest.spine
        lateral = np.broadcast_to(_vector(LEFT), self.pos["Hips"].shape)
        chest = chest_frame(self.tracks, self.rest.points[spine[-1]])
        for i, name in enumerate(spine):
            self._place(name)
            if name == spine[-1]:
                self.quat[name] = self._chest(name)
                break
            up = self._track(spine[i + 1]) - self.pos[name]
            share = np.full_like(up[:, 0], (i + 1) / len(spine))
            between = slerp(self.quat["Hips"], chest, share)
            x = rejected(quat_rotate(between, lateral), normalize(up))
            self.quat[name] = frame_quat(x, up)

    def _chest(self, name: str) -> np.ndarray:
        """The chest's rotation: neck and collars (or shoulders, which count less) as one cluster."""
        own = collars_tell_sides(self.tracks)
        names, template = ["Neck"], [self.rest.offsets["Neck"]]
        for side in SIDES:
            collar = self.rest.offsets[f"{TITLE[side]}Shoulder"]
            reach = 0.0 if own else self.rest.offsets[f"{TITLE[side]}Arm"]
            names.append(f"{TITLE[side]}{'Shoulder' if own else 'Arm'}")
            template.append(collar + reach)
        seen = np.stack([self._track(n) - self.pos[name] for n in names], 1)
        weights = np.asarray([1.0, 1.0, 1.0] if own else [1.0, 0.5, 0.5], dtype=float)
        return cluster_quat(np.stack([_vector(v) for v in template]), seen, weights)

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
            left = cross(up, tracks["face"] - tracks["neck"])
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
            now = quat_rotate(
                self.quat[lower], np.broadcast_to(_vector(self.rest.tips[hand]), self.pos[hand].shape)
            )
            seen = self.tracks[f"{side}_hand"] - self.tracks[f"{side}_wrist"]
            self.quat[hand] = quat_mul(shortest_arc(now, seen), self.quat[lower])

    def _hinged(
        self, upper: str, lower: str, end: str, axis: np.ndarray, hint: np.ndarray | None
    ) -> None:
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
        hinge = cross(d1, d2)
        if hint is not None:
            hinge = hinge + rejected(hint, d1)
        zero = quat_rotate(swing, np.broadcast_to(axis, d1.shape))
        quarter = cross(d1, zero)
        shown = np.stack(((hinge * zero).sum(-1), (hinge * quarter).sum(-1)), -1)
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
        template = np.stack([*(_vector(cluster[p]) for p in places), 0.1 * _vector(LEFT)])
        seen = np.stack([*(self.tracks[f"{side}_{p}"] - ankle for p in places), 0.1 * left], 1)
        weights = np.ones(len(places) + 1)
        weights[-1] = 0.2
        self.quat[foot] = cluster_quat(template, seen, weights)
        self._place(toe)
        self.quat[toe] = self.quat[foot]


def steady_twist(shown: np.ndarray, fps: float) -> np.ndarray:
    """Twist angles `(T)` from observations `(T, 2)`: cosine and sine, as long as they can be trusted.

    Minimises sum w |z_t - o_t|^2 + (TWIST_S fps)^2 |z_t+1 - z_t|^2 + e |z_t - 1|^2 over complex z, with
    o the direction of the observation and w the fourth power of its length in units of a bend at which
    it counts fully. Where no bend shows the twist, it passes from one observation to the next; without
    any, it is zero. Complex numbers know no jump from pi to -pi.
    """
    length = norm(shown)
    weight = np.minimum(np.power(length / _BENT, 4), 1e3)
    unit = shown / np.maximum(length, 1e-12)[..., None]
    # No shoulder or hip twists beyond some 130 degrees: there the bend is a noisy, straight limb's.
    weight = weight * np.clip((unit[..., 0] + _BEYOND) / _BEYOND, 0.0, 1.0)
    prior, between = 1e-6, (TWIST_S * fps) ** 2
    right = weight[..., None] * unit
    right = right + prior * np.array([1.0, 0.0], dtype=shown.dtype)
    diagonal = weight + prior + between * 2.0
    diagonal[0], diagonal[-1] = diagonal[0] - between, diagonal[-1] - between
    # The upper band; its first number stands outside the matrix, and a single frame has none.
    bands = np.stack((np.full(len(diagonal), -between), diagonal))
    from scipy.linalg import solveh_banded

    z = solveh_banded(bands[-len(diagonal) :], right)
    return np.arctan2(z[:, 1], z[:, 0])


def hold_lengths(
    tracks: dict[str, np.ndarray], bones: list[tuple[str, str, float]], rounds: int = _ROUNDS
) -> dict[str, np.ndarray]:
    """The tracks moved as little as needed so that each bone `(place, place, m)` has its length.

    Each round moves both ends of every bone by half of its error (position-based dynamics, Mueller et
    al. 2007), which spreads the error of a limb over its joints instead of piling it up at the end.
    """
    out = dict(tracks)
    for _ in range(rounds):
        for a, b, length in bones:
            line = out[b] - out[a]
            now = np.maximum(norm(line, keepdims=True), 1e-9)
            move = line * (0.5 * (now - length) / now)
            out[a], out[b] = out[a] + move, out[b] - move
    return out
