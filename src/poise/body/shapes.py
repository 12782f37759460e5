"""Measures of a skeleton and the capsules and boxes that give its bones volume."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from poise.body import body_table as presets
from poise.body.body_table import PARTS, Geom
from poise.body.parts import Anatomy, Part
from poise.errors import PoiseError
from poise.motion import Clip, Skeleton
from poise.motion.rotations import matrix_to_quat, quat_mul, quat_rotate_inv

Links = Mapping[int, tuple[int, np.ndarray, np.ndarray]]
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Ruler:
    """Measures in metres, directions as unit vectors in each joint's own frame.

    Attributes:
        anatomy: the parts of the skeleton.
        height: standing height.
        tips: bone vector of every part.
        lateral: right to left at the pelvis and at the chest.
        hip_width: distance of the hip joints.
        soles: per foot joint (down, forward, ankle height, toe reach).
    """

    anatomy: Anatomy
    height: float
    tips: dict[int, np.ndarray]
    lateral: dict[int, np.ndarray]
    hip_width: float
    soles: dict[int, tuple[np.ndarray, np.ndarray, float, float]]

    @classmethod
    def measure(cls, skeleton: Skeleton, anatomy: Anatomy, links: Links, clips: Sequence[Clip]) -> Ruler:
        """Measures a skeleton; `clips` show how its soles lie when it stands."""
        leg = np.mean(
            [
                np.linalg.norm(links[shin][1]) + np.linalg.norm(links[foot][1])
                for shin, foot in zip(anatomy.of("shin"), anatomy.of("foot"), strict=True)
            ]
        )
        if not leg > 1e-3:
            raise PoiseError(
                f"the legs are {leg * 1000:.1f} mm long", skeleton.source.path, code="limb-too-short"
            )
        height = float(leg) * presets.HEIGHT_PER_LEG
        frames = _neutral_frames(anatomy, links)
        hips = [links[j][1] for j in (*anatomy.of("thigh", "left"), *anatomy.of("thigh", "right"))]
        side = _unit(hips[0] - hips[1])
        lateral = {p.joint: _rot_inv(frames[p.joint], side) for p in anatomy.parts}
        tips = {p.joint: _tip(skeleton, anatomy, links, p, height) for p in anatomy.parts}
        soles = {}
        for side_name in ("left", "right"):
            foot = anatomy.of("foot", side_name)[0]
            toe = dict(anatomy.toes).get(side_name)
            soles[foot] = _sole(skeleton, foot, toe, lateral[foot], height, clips)
        return cls(anatomy, height, tips, lateral, float(np.linalg.norm(hips[0] - hips[1])), soles)


def geoms_of(part: Part, ruler: Ruler) -> tuple[Geom, ...]:
    """The shapes of one part, sized from its bone and the standing height."""
    h, tip = ruler.height, ruler.tips[part.joint]
    radius = PARTS[part.kind].radius * h
    if part.kind == "pelvis":
        return (_across(np.zeros(3), ruler.lateral[part.joint], ruler.hip_width / 2, radius),)
    if part.kind == "spine":
        return (_across(tip / 2, ruler.lateral[part.joint], 0.042 * h, radius),)
    if part.kind == "foot":
        return (_sole_box(ruler.soles[part.joint], h),)
    if part.kind == "head":
        return (_along(tip, 0.05, 0.95, radius, h),)
    if (
        part.kind == "neck"
        and not ruler.anatomy.of("head")
        and part.joint == ruler.anatomy.of("neck")[-1]
    ):
        return (_along(tip * (0.17 * h / max(np.linalg.norm(tip), 1e-6)), 0.2, 0.8, 0.052 * h, h),)
    return (_along(tip, 0.0, 1.0, radius, h),)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / max(float(np.linalg.norm(v)), 1e-9)


def _rot_inv(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    return quat_rotate_inv(q, v)


def _neutral_frames(anatomy: Anatomy, links: Links) -> dict[int, np.ndarray]:
    """wxyz of every part in the pelvis frame at the neutral pose."""
    out = {anatomy.parts[0].joint: np.array([1.0, 0.0, 0.0, 0.0])}
    for part in anatomy.parts[1:]:
        anchor, _, quat = links[part.joint]
        out[part.joint] = quat_mul(out[anchor], quat)
    return out


def _tip(skeleton: Skeleton, anatomy: Anatomy, links: Links, part: Part, height: float) -> np.ndarray:
    """The vector from a joint to the end of its bone, in the joint's frame, m."""
    order = ("spine", "neck", "head") if part.kind in ("spine", "neck") else ()
    nexts = {"thigh": "shin", "shin": "foot", "clavicle": "upper_arm", "upper_arm": "forearm"}
    nexts["forearm"] = "hand"
    followers = [p for p in anatomy.parts if links[p.joint][0] == part.joint and p.joint != part.joint]
    for p in followers:
        if p.kind in order or nexts.get(part.kind) == p.kind:
            return links[p.joint][1]
    below = skeleton.children(part.joint)
    own = [skeleton.offsets[c] for c in below] + [
        np.array(v) for j, v in skeleton.ends if j == part.joint
    ]
    own = [v for v in own if np.linalg.norm(v) > 1e-3]
    size = {"hand": 0.055, "head": 0.12, "neck": 0.05, "spine": 0.08}.get(part.kind, 0.05) * height
    if own and part.kind in ("hand", "head", "neck"):
        return _unit(max(own, key=lambda v: float(np.linalg.norm(v)))) * size
    # A leaf without a tip goes on in its parent bone's direction.
    _, pos, quat = links[part.joint]
    return _unit(_rot_inv(quat, pos)) * size if np.linalg.norm(pos) > 1e-6 else _UP * size


def _along(tip: np.ndarray, start: float, stop: float, radius: float, height: float) -> Geom:
    """A capsule along a bone, shortened so that neighbours do not overlap by whole radii."""
    length = float(np.linalg.norm(tip))
    half = max((stop - start) * length / 2 - 0.3 * radius, 0.003 * height)
    return Geom("capsule", (radius, half, 0.0), tuple(tip * (start + stop) / 2), _z_to(tip))


def _across(centre: np.ndarray, lateral: np.ndarray, half: float, radius: float) -> Geom:
    return Geom("capsule", (radius, half, 0.0), tuple(centre), _z_to(lateral))


def _z_to(v: np.ndarray) -> tuple[float, float, float, float]:
    """wxyz of the shortest turn from +z to `v`."""
    z, v = np.array([0.0, 0.0, 1.0]), _unit(v)
    w = 1.0 + float(z @ v)
    q = np.array([0.0, 1.0, 0.0, 0.0]) if w < 1e-8 else np.concatenate(([w], np.cross(z, v)))
    return tuple(q / np.linalg.norm(q))


def _sole(
    skeleton: Skeleton,
    foot: int,
    toe: int | None,
    lateral: np.ndarray,
    height: float,
    clips: Sequence[Clip],
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Down and forward in the foot's frame, ankle above sole (m), toe tip ahead of the ankle (m).

    With clips, "down" is the mean world down over the fifth of all frames in which the foot is
    lowest: there it stands. Without, the rest pose stands.
    """
    down = -_UP
    if clips:
        rows = []
        for clip in clips:
            pos, quat = clip.world()
            watch = pos[:, [foot] if toe is None else [foot, toe], 2].max(1)
            low = watch <= np.quantile(watch, 0.2) + 1e-9
            rows.append(_rot_inv(quat[low, foot], np.broadcast_to(-_UP, (int(low.sum()), 3)).copy()))
        mean = np.concatenate(rows).mean(0)
        down = _unit(mean) if np.linalg.norm(mean) > 0.5 else down
    reach, drop, ahead = presets.FOOT_LENGTH * height - presets.HEEL_LENGTH * height, 0.0, None
    if toe is not None and np.linalg.norm(skeleton.offsets[toe]) > 1e-3:
        at = skeleton.offsets[toe]
        ahead = at - (at @ down) * down
        drop = float(at @ down)
        # A rigid sole ends a little beyond the ball: the toes of a real foot bend at push-off, and
        # a longer box would poke through the floor there.
        reach = float(np.linalg.norm(ahead)) + presets.BEYOND_BALL * height
    if ahead is None or np.linalg.norm(ahead) < 1e-3:
        ahead = np.cross(lateral, -down)
        ahead = ahead - (ahead @ down) * down
    ankle = max(presets.ANKLE_HEIGHT * height, drop + 0.010 * height)
    return down, _unit(ahead), ankle, reach


def _sole_box(sole: tuple[np.ndarray, np.ndarray, float, float], height: float) -> Geom:
    """A box under the ankle from heel to toe tip, its lower face on the sole."""
    down, forward, ankle, reach = sole
    heel, half_z = presets.HEEL_LENGTH * height, 0.010 * height
    x, z = forward, -down
    axes = np.stack((x, np.cross(z, x), z), 1)
    centre = x * (reach - heel) / 2 - z * (ankle - half_z)
    size = ((reach + heel) / 2, presets.FOOT_WIDTH * height / 2, half_z)
    return Geom("box", size, tuple(centre), tuple(matrix_to_quat(axes).tolist()))
