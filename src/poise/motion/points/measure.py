"""A skeleton measured on the tracks of a body: robust lengths, rest places, interpolated joints."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from poise.motion.io.text import listed
from poise.motion.points.labels import SIDES
from poise.spatial import frame_quat, quat_rotate_inv, rejected

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


def spine_shares(tracks: dict[str, Tensor]) -> dict[str, float]:
    """How far up each of the spine's places lies on the way from the pelvis to the neck, by median."""
    line = tracks["neck"] - tracks["pelvis"]
    return {
        place: float((((track - tracks["pelvis"]) * line).sum(-1) / line.square().sum(-1)).median())
        for place, track in tracks.items()
        if place.startswith("spine")
    }


def trunk_tracks(
    tracks: dict[str, Tensor], notes: list[str], share: dict[str, float] | None = None
) -> tuple[dict[str, Tensor], list[str]]:
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


def _head(tracks: dict[str, Tensor]) -> Tensor:
    neck = tracks["neck"]
    if "head_top" in tracks:
        return neck + _HEAD_OF_TOP * (tracks["head_top"] - neck)
    sides = [("left_ear", "right_ear"), ("left_eye", "right_eye")]
    for left, right in sides:
        if left in tracks and right in tracks:
            return (tracks[left] + tracks[right]) / 2
    trunk = neck - tracks["pelvis"]
    length = _HEAD_SHARE / _LEG_SHARE * _leg(tracks)
    return neck + length * trunk / trunk.norm(dim=-1, keepdim=True).clamp_min(1e-9)


def _leg(tracks: dict[str, Tensor]) -> float:
    """Median length of a leg from hip to ankle along its bones, m."""
    return float(
        np.mean([_median(tracks, f"{s}_{a}", f"{s}_{b}") for s in SIDES for a, b in
                 (("hip", "knee"), ("knee", "ankle"))]) * 2
    )  # fmt: skip


def _median(tracks: dict[str, Tensor], a: str, b: str) -> float:
    """Median distance of two places over the frames, m."""
    return float((tracks[a] - tracks[b]).norm(dim=-1).median())


def _local(frame: Tensor, v: Tensor) -> np.ndarray:
    """Median of the vectors `(T, 3)` as seen from frames `(T, 4)`, in rest axes."""
    return quat_rotate_inv(frame, v).median(0).values.numpy()


def pelvis_frame(tracks: dict[str, Tensor], spine: str) -> Tensor:
    """wxyz `(T, 4)`: x from right to left hip, z towards the spine."""
    hips = (tracks["left_hip"] + tracks["right_hip"]) / 2
    return frame_quat(tracks["left_hip"] - tracks["right_hip"], tracks[spine] - hips)


def collars_tell_sides(tracks: dict[str, Tensor]) -> bool:
    """Whether there are collars, and not both in one place, as where they hang on the neck."""
    if not all(f"{s}_collar" in tracks for s in SIDES):
        return False
    apart, width = (_median(tracks, f"left_{p}", f"right_{p}") for p in ("collar", "shoulder"))
    return apart > _ONE_PLACE * width


def chest_frame(tracks: dict[str, Tensor], chest: str) -> Tensor:
    """wxyz `(T, 4)`: z from the chest joint to the neck, x from right to left shoulder."""
    up = tracks["neck"] - tracks[chest]
    part = "collar" if collars_tell_sides(tracks) else "shoulder"
    x = rejected(tracks[f"left_{part}"] - tracks[f"right_{part}"], up / up.norm(dim=-1, keepdim=True))
    return frame_quat(x, up)


def foot_axes(tracks: dict[str, Tensor], side: str) -> tuple[Tensor, Tensor]:
    """Forward along the sole and towards the left `(T, 3)`, unit length up to rounding.

    Forward is from heel to toes, or from the ankle where no heel is seen; left is square to it and to
    the shin.
    """
    ankle = tracks[f"{side}_ankle"]
    front = tracks[f"{side}_toe_tip" if f"{side}_toe_tip" in tracks else f"{side}_toe"]
    forward = front - tracks.get(f"{side}_heel", ankle)
    left = torch.linalg.cross(tracks[f"{side}_knee"] - ankle, forward, dim=-1)
    unit = forward / forward.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    return unit, left / left.norm(dim=-1, keepdim=True).clamp_min(1e-9)


def measure(tracks: dict[str, Tensor], spine: list[str], notes: list[str]) -> Rest:
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


def _both(tracks: dict[str, Tensor], a: str, b: str) -> float:
    """The length of a bone of both sides: the mean of their medians, m."""
    return float(np.mean([_median(tracks, f"{s}_{a}", f"{s}_{b}") for s in SIDES]))


def _leg_joints(rest: Rest, tracks: dict[str, Tensor], side: str, hip: np.ndarray) -> None:
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


def _ball_track(tracks: dict[str, Tensor], side: str) -> Tensor:
    start = tracks.get(f"{side}_heel", tracks[f"{side}_ankle"])
    return start + _BALL_SHARE * (tracks[f"{side}_toe_tip"] - start)


def _foot_cluster(tracks: dict[str, Tensor], side: str) -> dict[str, np.ndarray]:
    """Places of toe, toe tip and heel as seen from the ankle in a foot that stands, m.

    With a heel the sole's line is level. Without, the ball lies a usual height below the ankle.
    """
    parts = [p for p in ("toe", "toe_tip", "heel") if f"{side}_{p}" in tracks]
    if not {"toe", "toe_tip"} & set(parts):
        return {}
    ankle = tracks[f"{side}_ankle"]
    if "heel" in parts:
        forward, left = foot_axes(tracks, side)
        frame = frame_quat(left, torch.linalg.cross(forward, left, dim=-1))
        return {p: _local(frame, tracks[f"{side}_{p}"] - ankle) for p in parts}
    leg = _leg(tracks)
    return {p: _sloping(_median(tracks, f"{side}_ankle", f"{side}_{p}"), leg) for p in parts}


def _sloping(length: float, leg: float) -> np.ndarray:
    """A vector of `length` from the ankle to the ball of a standing foot."""
    drop = min(_BALL_DROP / _LEG_SHARE * leg, 0.7 * length)
    return -BACK * np.sqrt(length**2 - drop**2) - UP * drop


def _arm_joints(rest: Rest, tracks: dict[str, Tensor], chest: str, parent: str) -> None:
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


def _note_asymmetry(rest: Rest, tracks: dict[str, Tensor]) -> None:
    odd = []
    bones = (("hip", "knee", "thigh"), ("knee", "ankle", "shin"), ("shoulder", "elbow", "upper arm"))
    for a, b, name in (*bones, ("elbow", "wrist", "forearm")):
        left, right = (_median(tracks, f"{s}_{a}", f"{s}_{b}") for s in SIDES)
        if abs(left - right) > _ASYMMETRY * max(left, right):
            odd.append(f"{name} {left * 1e3:.0f} and {right * 1e3:.0f} mm")
    if odd:
        rest.notes.append(f"Left and right differ and were averaged: {listed(odd)}")
