"""Poise in Blender: an armature's action is examined, tracked or completed by the `poise` command.

The command runs in a process of its own with its own Python; nothing of it is imported here. Motion goes
there and comes back as BVH.
"""

from __future__ import annotations

import bpy

from . import panel, run

bl_info = {
    "name": "Poise",
    "author": "Poise contributors",
    "version": (0, 1, 0),
    "blender": (4, 2, 0),
    "location": "3D Viewport > Sidebar > Poise",
    "description": "Examine, track and complete an armature's action with physics",
    "category": "Animation",
}

_CLASSES = (panel.PoiseSettings, run.POISE_OT_run, run.POISE_OT_open, panel.POISE_PT_panel)


def register() -> None:
    """Adds the settings, the operator and the panel."""
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.poise = bpy.props.PointerProperty(type=panel.PoiseSettings)


def unregister() -> None:
    """Takes them away."""
    del bpy.types.Scene.poise
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
