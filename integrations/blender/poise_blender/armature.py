"""An armature's motion as joints in the world, and joints in the world as a new action."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from .bvh import Motion


class RefusedError(Exception):
    """What cannot be done, in a sentence for the user."""


def joints_of(body: bpy.types.Object) -> list[str]:
    """The bones that go to Poise, parents first: all below the root with most bones, and the root."""
    roots = [b for b in body.data.bones if b.parent is None]
    if not roots:
        raise RefusedError(f"{body.name} has no bones")
    root = max(roots, key=lambda b: len(b.children_recursive))
    out, stack = [], [root]
    while stack:
        bone = stack.pop()
        out.append(bone.name)
        stack += reversed(bone.children)
    return out


def _world(body: bpy.types.Object, unit: float) -> tuple[np.ndarray, float]:
    """The armature's turn in the world `(3, 3)`, and metres in one of its own units."""
    _, turn, scale = body.matrix_world.decompose()
    if max(scale) - min(scale) > 1e-4 * max(scale) or min(scale) <= 0:
        raise RefusedError(f"{body.name} is scaled unevenly or mirrored: apply its scale first")
    return np.array(turn.to_matrix()), float(scale[0]) * unit


def motion_of(scene: bpy.types.Scene, body: bpy.types.Object, first: int, last: int) -> Motion:
    """The armature as it stands in the scene in frames `first` to `last`, constraints and all."""
    names = joints_of(body)
    bones = body.data.bones
    index = {name: j for j, name in enumerate(names)}
    parents = tuple(index[bones[n].parent.name] if j else -1 for j, n in enumerate(names))
    turn, size = _world(body, scene.unit_settings.scale_length)
    rest = np.array([np.array(bones[n].matrix_local) for n in names])
    heads, turns = [], []
    now = scene.frame_current
    for frame in range(first, last + 1):
        scene.frame_set(frame)
        posed = np.array([np.array(body.pose.bones[n].matrix) for n in names])
        world = np.array(body.matrix_world)
        heads.append(
            (posed[:, :3, 3] @ world[:3, :3].T + world[:3, 3]) * scene.unit_settings.scale_length
        )
        turns.append(_pure(posed[:, :3, :3]) @ _pure(rest[:, :3, :3]).transpose(0, 2, 1))
    scene.frame_set(now)
    head, delta = np.array(heads), turn @ np.array(turns) @ turn.T
    local, places = delta.copy(), head.copy()
    offsets = np.zeros((len(names), 3))
    for j, p in enumerate(parents):
        if p >= 0:
            back = delta[:, p].transpose(0, 2, 1)
            local[:, j] = back @ delta[:, j]
            places[:, j] = np.einsum("tab,tb->ta", back, head[:, j] - head[:, p])
            offsets[j] = turn @ (rest[j, :3, 3] - rest[p, :3, 3]) * size
    tips = np.array([np.array(bones[n].tail_local - bones[n].head_local) for n in names])
    fps = scene.render.fps / scene.render.fps_base
    return Motion(tuple(names), parents, offsets, tips @ turn.T * size, places, local, fps)


def _pure(turns: np.ndarray) -> np.ndarray:
    """Rotations without scale: the nearest ones, which are proper."""
    u, _, v = np.linalg.svd(turns)
    u[..., -1] *= np.sign(np.linalg.det(u @ v))[..., None]
    return u @ v


def new_action(
    scene: bpy.types.Scene, body: bpy.types.Object, motion: Motion, name: str, first: float
) -> bpy.types.Action:
    """A new action with a key in every frame, shown by the armature; the one before stays."""
    names = joints_of(body)
    if list(motion.names) != names and sorted(motion.names) != sorted(names):
        raise RefusedError("what came back has other bones than the armature")
    turn, _ = _world(body, scene.unit_settings.scale_length)
    world = np.array(body.matrix_world)
    delta = motion.turns.copy()
    heads = motion.places.copy()
    for j, p in enumerate(motion.parents):
        if p >= 0:
            delta[:, j] = delta[:, p] @ motion.turns[:, j]
            heads[:, j] = heads[:, p] + np.einsum("tab,tb->ta", delta[:, p], motion.places[:, j])
    delta = turn.T @ delta @ turn
    down = np.linalg.inv(world)
    place = heads / scene.unit_settings.scale_length @ down[:3, :3].T + down[:3, 3]
    bones = body.data.bones
    rest = np.array([np.array(bones[n].matrix_local) for n in motion.names])
    posed = np.tile(np.eye(4), (len(place), len(names), 1, 1))
    posed[:, :, :3, :3] = delta @ rest[:, :3, :3]
    posed[:, :, :3, 3] = place
    animation = body.animation_data_create()
    action = bpy.data.actions.new(name)
    animation.action = action
    curves = _curves(action, body)
    frames = first + np.arange(len(place)) * (scene.render.fps / scene.render.fps_base / motion.fps)
    moving = motion.travels()
    for j, bone in enumerate(motion.names):
        p = motion.parents[j]
        above_rest = np.eye(4) if p < 0 else rest[p]
        above = np.tile(np.eye(4), (len(place), 1, 1)) if p < 0 else posed[:, p]
        joint = np.linalg.inv(above_rest) @ rest[j]
        basis = np.linalg.inv(above @ joint) @ posed[:, j]
        pose = body.pose.bones[bone]
        path = pose.path_from_id()
        _keys(curves, f"{path}.location", frames, basis[:, :3, 3] * moving[j])
        _turn_keys(curves, pose, path, frames, basis[:, :3, :3])
        pose.scale = (1.0, 1.0, 1.0)
    return action


def _curves(action: bpy.types.Action, body: bpy.types.Object) -> Any:
    """The place for the action's curves, in Blender before and after 4.4."""
    if not hasattr(action, "slots"):
        return action.fcurves
    slot = action.slots.new("OBJECT", body.name)
    body.animation_data.action_slot = slot
    strip = action.layers.new("Poise").strips.new(type="KEYFRAME")
    return strip.channelbag(slot, ensure=True).fcurves


def _keys(curves: Any, path: str, frames: np.ndarray, values: np.ndarray) -> None:
    for i in range(values.shape[1]):
        curve = curves.new(path, index=i)
        curve.keyframe_points.add(len(frames))
        curve.keyframe_points.foreach_set("co", np.stack((frames, values[:, i]), -1).ravel())
        linear = bpy.types.Keyframe.bl_rna.properties["interpolation"].enum_items["LINEAR"].value
        curve.keyframe_points.foreach_set("interpolation", np.full(len(frames), linear, dtype=np.int32))
        curve.update()


def _turn_keys(curves: Any, pose: bpy.types.PoseBone, path: str, frames: np.ndarray, turns: Any) -> None:
    """Keys in the bone's own rotation mode, continuous from one frame to the next."""
    from mathutils import Matrix

    mode, values, before = pose.rotation_mode, [], None
    for turn in turns:
        matrix = Matrix(turn.tolist())
        if mode in ("QUATERNION", "AXIS_ANGLE"):
            quat = matrix.to_quaternion()
            if before is not None:
                quat.make_compatible(before)
            before = quat
            values.append(list(quat))
        else:
            before = matrix.to_euler(mode) if before is None else matrix.to_euler(mode, before)
            values.append(list(before))
    if mode == "AXIS_ANGLE":
        pose.rotation_mode, mode = "QUATERNION", "QUATERNION"
    channel = "rotation_quaternion" if mode == "QUATERNION" else "rotation_euler"
    _keys(curves, f"{path}.{channel}", frames, np.array(values))
