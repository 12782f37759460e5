"""Run by a Python that has `bpy`: an armature moves, its action goes out and comes back.

python blender_session.py ADD_ON_FOLDER OUT.json VERBS COMMAND...

VERBS are words of the panel with commas between: what it does one after another, each with the action of
the start.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

#: Bone, parent, head and tail in the armature's own centimetres, Y up.
BONES = (
    ("hips", None, (0, 95, 0), (0, 105, 0)),
    ("spine", "hips", (0, 105, 0), (0, 125, 2)),
    ("chest", "spine", (0, 125, 2), (0, 145, 0)),
    ("neck", "chest", (0, 148, 0), (0, 156, 1)),
    ("head", "neck", (0, 156, 1), (0, 175, 2)),
    *(
        row
        for side, x in (("left", 1), ("right", -1))
        for row in (
            (f"{side}_upper_arm", "chest", (18 * x, 143, 0), (45 * x, 143, -1)),
            (f"{side}_forearm", f"{side}_upper_arm", (45 * x, 143, -1), (70 * x, 143, 0)),
            (f"{side}_hand", f"{side}_forearm", (70 * x, 143, 0), (85 * x, 143, 0)),
            (f"{side}_thigh", "hips", (9 * x, 92, 0), (10 * x, 50, 1)),
            (f"{side}_shin", f"{side}_thigh", (10 * x, 50, 1), (10 * x, 9, -3)),
            (f"{side}_foot", f"{side}_shin", (10 * x, 9, -3), (11 * x, 2, 12)),
        )
    ),
)
FIRST, LAST = 5, 64


def armature() -> bpy.types.Object:
    """A figure of 1.75 m that stands along its own Y in centimetres, set upright and turned."""
    data = bpy.data.armatures.new("figure")
    body = bpy.data.objects.new("figure", data)
    bpy.context.collection.objects.link(body)
    bpy.context.view_layer.objects.active = body
    body.select_set(True)
    bpy.ops.object.mode_set(mode="EDIT")
    for name, parent, head, tail in BONES:
        bone = data.edit_bones.new(name)
        bone.head, bone.tail, bone.roll = Vector(head), Vector(tail), 0.3
        if parent:
            bone.parent = data.edit_bones[parent]
    bpy.ops.object.mode_set(mode="OBJECT")
    turn = Matrix.Rotation(0.7, 4, "Z") @ Matrix.Rotation(math.pi / 2, 4, "X")
    body.matrix_world = Matrix.Translation((0.4, -1.2, 0.0)) @ turn @ Matrix.Scale(0.01, 4)
    return body


def animate(body: bpy.types.Object) -> None:
    """Sways and walks on the spot, in three rotation modes."""
    modes = ("QUATERNION", "XYZ", "ZYX")
    for i, bone in enumerate(body.pose.bones):
        bone.rotation_mode = modes[i % 3]
    for frame in range(FIRST, LAST + 1, 3):
        t = (frame - FIRST) / 30
        for i, bone in enumerate(body.pose.bones):
            swing = 0.25 * math.sin(2 * math.pi * t + i)
            turn = Matrix.Rotation(swing, 3, "X") @ Matrix.Rotation(0.4 * swing, 3, "Z")
            if bone.rotation_mode == "QUATERNION":
                bone.rotation_quaternion = turn.to_quaternion()
                bone.keyframe_insert("rotation_quaternion", frame=frame)
            else:
                bone.rotation_euler = turn.to_euler(bone.rotation_mode)
                bone.keyframe_insert("rotation_euler", frame=frame)
        hips = body.pose.bones["hips"]
        hips.location = (12 * t, 2 * math.sin(5 * t), 20 * t)
        hips.keyframe_insert("location", frame=frame)


def heads(body: bpy.types.Object) -> list[list[list[float]]]:
    """Where each bone's head stands in the world in each frame, m."""
    out = []
    for frame in range(FIRST, LAST + 1):
        bpy.context.scene.frame_set(frame)
        out.append([list(body.matrix_world @ body.pose.bones[b[0]].head) for b in BONES])
    return out


def main(addon: str, out: str, verbs: str, *command: str) -> None:
    """Writes what Blender shows before and after."""
    sys.path.insert(0, addon)
    import poise_blender
    from poise_blender import armature as exchange
    from poise_blender import bvh

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.frame_start, scene.frame_end = 30, FIRST, LAST
    poise_blender.register()
    body = armature()
    animate(body)
    before, start = heads(body), body.animation_data.action
    sent = exchange.motion_of(scene, body, FIRST, LAST)
    bvh.write(sent, Path(out).with_suffix(".bvh"))
    exchange.new_action(scene, body, bvh.read(Path(out).with_suffix(".bvh")), "again", FIRST)
    told = {"names": [b[0] for b in BONES], "before": before, "again": heads(body)}
    exchange.new_action(scene, body, bvh.read(Path(out).with_suffix(".bvh")), "there", FIRST)
    if command:
        scene.poise.command = " ".join(f'"{c}"' for c in command)
        there = body.animation_data.action
        for verb in verbs.split(","):
            # What was baked has a key in every frame; keyframes to complete are those of the start.
            body.animation_data.action = there if verb == "doctor" else start
            scene.poise.verb, scene.poise.controller = verb, "policy"
            ended = sorted(bpy.ops.poise.run())
            action = body.animation_data.action
            told[verb] = {
                "ended": ended,
                "told": scene.poise.told,
                "after": heads(body),
                "action": action.name,
                "range": [float(x) for x in action.frame_range],
            }
        told["start"] = start.name
        scene.poise.command = "no-such-command"
        try:
            bpy.ops.poise.run()
        except RuntimeError as refused:
            told["refused"] = str(refused)
        told["kept"] = body.animation_data.action.name
    poise_blender.unregister()
    Path(out).write_text(json.dumps(told), encoding="utf-8")
    np.testing.assert_array_equal(np.array(before).shape, (LAST - FIRST + 1, len(BONES), 3))


if __name__ == "__main__":
    main(*sys.argv[1:])
