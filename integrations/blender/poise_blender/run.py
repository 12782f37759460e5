"""The operator: the action goes to the `poise` command, and what comes back is a new action."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy

from . import armature, bvh

#: A motion that was lost comes back all the same, with this exit code.
LOST = 3


def program_of(settings: Any) -> list[str]:
    """The words that start Poise."""
    program = bpy.path.abspath(settings.command)
    # A path may hold spaces; a command with options may be given as well.
    return [program] if Path(program).is_file() else shlex.split(program, posix=os.name != "nt")


def command_of(settings: Any, clip: Path, out: Path, keys: Sequence[int]) -> list[str]:
    """The command line for a motion. keys: the action's keyframes, counted from its first frame."""
    stated = ["--unit", "m", "--up", "Z", "--json"]
    words = [*program_of(settings), settings.verb, str(clip), "-o", str(out), *stated]
    if settings.verb == "doctor":
        words += ["--fix"]
    else:
        words += ["--controller", settings.controller]
    if settings.verb == "complete":
        words += ["--keyframes", ",".join(map(str, keys))]
    return [*words, *shlex.split(settings.extra)]


def curves_of(action: bpy.types.Action) -> list[Any]:
    """All curves of an action, in Blender before and after 4.4."""
    if not hasattr(action, "layers"):
        return list(action.fcurves)
    bags = [bag for layer in action.layers for strip in layer.strips for bag in strip.channelbags]
    return [curve for bag in bags for curve in bag.fcurves]


def keyed_frames(action: bpy.types.Action, first: int) -> list[int]:
    """Frames of the action that hold a key, counted from `first`."""
    found = {round(k.co[0]) - first for curve in curves_of(action) for k in curve.keyframe_points}
    return sorted(k for k in found if k >= 0)


def told(stdout: str, stderr: str, code: int) -> str:
    """What came of the command, in a few lines for the panel."""
    try:
        answer = json.loads(stdout)
    except ValueError:
        lines = (stderr or stdout).strip().splitlines()
        return lines[-1] if lines else f"poise ended with code {code}"
    if answer.get("error"):
        error = answer["error"]
        return ". ".join(x for x in (error["what"], error["hint"]) if x)
    result = answer.get("result") or {}
    if "faults" in result:
        left = len((result.get("fixed") or {}).get("faults", ()))
        return f"{len(result['faults'])} faults before, {left} after"
    return result.get("sentence") or answer["verb"]


class POISE_OT_open(bpy.types.Operator):  # noqa: N801
    """Show the action on Poise's page, in the browser; what it saves is imported with File > Import"""

    bl_idname = "poise.open"
    bl_label = "Open in Poise"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """True where an armature with an action is selected."""
        return POISE_OT_run.poll(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Writes the action, and starts the page, whose server ends when it is closed."""
        scene, body = context.scene, context.object
        action, settings = body.animation_data.action, scene.poise
        folder = Path(tempfile.mkdtemp(prefix="poise-open-"))
        clip = folder / f"{bpy.path.clean_name(action.name)}.bvh"
        try:
            bvh.write(armature.motion_of(scene, body, *(round(x) for x in action.frame_range)), clip)
            words = [*program_of(settings), "open", str(clip), "--project", str(folder / "project")]
            words += ["--port", "0", "--once", "--unit", "m", "--up", "Z"]
            subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        except (armature.RefusedError, OSError) as problem:
            missing = isinstance(problem, FileNotFoundError)
            settings.told = f"{settings.command} was not found; set Command" if missing else str(problem)
            self.report({"ERROR"}, settings.told)
            return {"CANCELLED"}
        settings.told = "The page opens in the browser"
        return {"FINISHED"}


class POISE_OT_run(bpy.types.Operator):  # noqa: N801
    """Give the action to Poise; the result becomes a new action, and this one stays."""

    bl_idname = "poise.run"
    bl_label = "Run Poise"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether an armature with an action is selected."""
        body = context.object
        return (
            body is not None
            and body.type == "ARMATURE"
            and bool(body.animation_data and body.animation_data.action)
        )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Waits for the command."""
        if not self._begin(context):
            return {"CANCELLED"}
        self.process.wait()
        return self._end(context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Lets Blender go on while the command runs; Escape ends it."""
        if not self._begin(context):
            return {"CANCELLED"}
        manager = context.window_manager
        self.timer = manager.event_timer_add(0.2, window=context.window)
        manager.modal_handler_add(self)
        context.scene.poise.told = "Running; Escape ends it"
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Looks whether the command has ended."""
        if event.type == "ESC":
            self.process.terminate()
            self.process.wait()
            return self._closed(context, "Ended by Escape; nothing was changed")
        if event.type != "TIMER" or self.process.poll() is None:
            return {"PASS_THROUGH"}
        return self._end(context)

    def _begin(self, context: bpy.types.Context) -> bool:
        scene, body = context.scene, context.object
        settings, action = scene.poise, body.animation_data.action
        self.body, self.action, self.timer = body, action, None
        self.first, last = (round(x) for x in action.frame_range)
        self.folder = Path(tempfile.mkdtemp(prefix="poise-"))
        try:
            motion = armature.motion_of(scene, body, self.first, last)
            clip, self.out = self.folder / "action.bvh", self.folder / "out.bvh"
            bvh.write(motion, clip)
            keys = keyed_frames(action, self.first)
            self.logs = [(self.folder / n).open("w+", encoding="utf-8") for n in ("out.txt", "err.txt")]
            words = command_of(settings, clip, self.out, keys)
            self.process = subprocess.Popen(words, stdout=self.logs[0], stderr=self.logs[1])
        except (armature.RefusedError, OSError) as problem:
            missing = isinstance(problem, FileNotFoundError)
            text = f"{settings.command} was not found; set Command" if missing else str(problem)
            self._closed(context, text)
            return False
        return True

    def _end(self, context: bpy.types.Context) -> set[str]:
        for log in self.logs:
            log.seek(0)
        text = told(self.logs[0].read(), self.logs[1].read(), self.process.returncode)
        if self.process.returncode not in (0, LOST) or not self.out.exists():
            return self._closed(context, text)
        try:
            motion = bvh.read(self.out)
            verb = context.scene.poise.verb
            name = f"{self.action.name} {verb}"
            armature.new_action(context.scene, self.body, motion, name, self.first)
        except (armature.RefusedError, ValueError, OSError) as problem:
            return self._closed(context, str(problem))
        if context.scene.poise.mute and (muted := self._mute()):
            text += f"\nMuted constraints on {muted} bones"
        return self._closed(context, text, done=True)

    def _mute(self) -> int:
        bones = [b for b in self.body.pose.bones if any(not c.mute for c in b.constraints)]
        for bone in bones:
            for constraint in bone.constraints:
                constraint.mute = True
        return len(bones)

    def _closed(self, context: bpy.types.Context, text: str, done: bool = False) -> set[str]:
        for log in getattr(self, "logs", ()):
            log.close()
        if self.timer is not None:
            context.window_manager.event_timer_remove(self.timer)
        shutil.rmtree(self.folder, ignore_errors=True)
        context.scene.poise.told = text
        self.report({"INFO"} if done else {"ERROR"}, text)
        return {"FINISHED"} if done else {"CANCELLED"}
