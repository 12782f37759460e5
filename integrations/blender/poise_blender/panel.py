"""The panel in the 3D viewport's sidebar, and its settings."""

from __future__ import annotations

import bpy

VERBS = (
    ("doctor", "Doctor", "Find what no body can have done, and mend what can be mended"),
    ("track", "Track", "Let a simulated body do the motion, without help"),
    (
        "complete",
        "Complete",
        "Make the motion between the keyframes of the action, and let a body do it",
    ),
)
CONTROLLERS = (
    ("auto", "Auto", "The policy; what it loses is searched for"),
    ("policy", "Policy", "The policy alone: seconds"),
    ("lookahead", "Lookahead", "Looks ahead at every step: minutes, and nearer"),
)


class PoiseSettings(bpy.types.PropertyGroup):
    """What the panel asks for, kept with the scene.

    Attributes:
        command: the `poise` command, a path or a name.
        verb, controller: see `VERBS` and `CONTROLLERS`.
        extra: further options of the command, as in a shell.
        mute: constraints on bones of the armature are muted where the result is shown.
        told: what came of the last run.
    """

    command: bpy.props.StringProperty(name="Command", default="poise", subtype="FILE_PATH")
    verb: bpy.props.EnumProperty(name="Do", items=VERBS, default="track")
    controller: bpy.props.EnumProperty(name="Controller", items=CONTROLLERS, default="auto")
    extra: bpy.props.StringProperty(name="Options", default="")
    mute: bpy.props.BoolProperty(
        name="Mute constraints",
        default=True,
        description="The result is baked, and constraints would pull it away",
    )
    told: bpy.props.StringProperty(name="Told", default="")


class POISE_PT_panel(bpy.types.Panel):  # noqa: N801
    """The panel."""

    bl_label = "Poise"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Poise"

    def draw(self, context: bpy.types.Context) -> None:
        """What Blender calls to show it."""
        layout, settings = self.layout, context.scene.poise
        body = context.object
        if body is None or body.type != "ARMATURE":
            layout.label(text="Select an armature", icon="ARMATURE_DATA")
            return
        animation = body.animation_data
        action = None if animation is None else animation.action
        layout.label(text=action.name if action else "No action", icon="ACTION")
        layout.prop(settings, "verb")
        if settings.verb != "doctor":
            layout.prop(settings, "controller")
        layout.prop(settings, "mute")
        layout.prop(settings, "extra")
        layout.prop(settings, "command")
        row = layout.row()
        row.enabled = action is not None
        row.operator("poise.run")
        row.operator("poise.open")
        for line in settings.told.splitlines():
            layout.label(text=line)
