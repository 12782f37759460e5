"""The nodes. A motion is the path of a file, so that any node that saves one can come before."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from .command import answer_of, begin, fresh, given

_MOTION = ("STRING", {"default": "", "tooltip": "A motion file: BVH, GLB, npz of SMPL, TRC, ..."})
_FPS = (
    "FLOAT",
    {"default": 0.0, "min": 0.0, "max": 1000.0, "tooltip": "Frames per second; 0 is what the file says"},
)
_SEED = ("INT", {"default": 0, "min": 0, "max": 2**31 - 1})
CONTROLLERS = ("auto", "policy", "lookahead", "search")
FORMATS = (".bvh", ".fbx", ".glb", ".npz", ".csv", ".usda")


class _Node:
    """What all nodes share."""

    CATEGORY: ClassVar[str] = "Poise"
    FUNCTION: ClassVar[str] = "run"
    RETURN_TYPES: ClassVar[tuple[str, ...]] = ("STRING", "STRING")
    RETURN_NAMES: ClassVar[tuple[str, ...]] = ("motion", "told")

    @classmethod
    def IS_CHANGED(cls, motion: str = "", **_: Any) -> str:  # noqa: N802
        """A file that was written anew is read anew."""
        try:
            facts = given(motion).stat()
        except OSError:
            return ""
        return f"{facts.st_mtime_ns} {facts.st_size}"


def _reading(fps: float) -> list[str]:
    return ["--fps", f"{fps:g}"] if fps > 0 else []


class PoiseInfo(_Node):
    """What a motion file holds, and what had to be guessed."""

    RETURN_TYPES = ("STRING",)
    RETURN_NAMES = ("told",)
    OUTPUT_NODE = True

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:  # noqa: N802
        """See ComfyUI."""
        return {"required": {"motion": _MOTION}, "optional": {"fps": _FPS}}

    def run(self, motion: str, fps: float = 0.0) -> dict[str, Any]:
        """The facts in lines, shown below the node as well."""
        facts = answer_of(["info", str(given(motion)), *_reading(fps)])["result"]
        lines = [
            f"{facts['format']}, {facts['joints']} joints, {facts['height_m']:.2f} m tall, "
            f"{facts['frames']} frames at {facts['fps']:g} fps, {facts['seconds']:.2f} s",
            *(f"{g['what']}: {g['value']}. {g['evidence']}." for g in facts["guesses"]),
        ]
        text = "\n".join(lines)
        return {"ui": {"text": [text]}, "result": (text,)}


class PoiseDoctor(_Node):
    """What no body can have done is found and mended."""

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:  # noqa: N802
        """See ComfyUI."""
        rest = ("BOOLEAN", {"default": False, "tooltip": "Write it with a T-pose as its rest pose"})
        more = {"fps": _FPS, "rest_pose": rest, "format": (FORMATS,)}
        return {"required": {"motion": _MOTION}, "optional": more}

    def run(
        self, motion: str, fps: float = 0.0, rest_pose: bool = False, format: str = ".bvh"
    ) -> tuple[str, str]:
        """The mended motion's path, and how many faults there were and are."""
        clip = given(motion)
        out = fresh(clip, "doctor", format)
        words = ["doctor", str(clip), "--fix", "-o", str(out), *_reading(fps)]
        result = answer_of([*words, *(["--rest-pose"] if rest_pose else [])])["result"]
        left = len(result["fixed"]["faults"])
        return str(out), f"{len(result['faults'])} faults before, {left} after"


class PoiseTrack(_Node):
    """A simulated body does the motion, without help."""

    RETURN_TYPES = ("STRING", "STRING", "STRING")
    RETURN_NAMES = ("motion", "report", "told")

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:  # noqa: N802
        """See ComfyUI."""
        more = {"fps": _FPS, "controller": (CONTROLLERS,), "seed": _SEED, "format": (FORMATS,)}
        return {"required": {"motion": _MOTION}, "optional": more}

    def run(
        self,
        motion: str,
        fps: float = 0.0,
        controller: str = "auto",
        seed: int = 0,
        format: str = ".bvh",
    ) -> tuple[str, str, str]:
        """The simulated motion's path, that of its report, and how it went."""
        clip = given(motion)
        out = fresh(clip, "track", format)
        words = ["track", str(clip), "-o", str(out), "--controller", controller, "--seed", str(seed)]
        return _simulated(answer_of([*words, *_reading(fps)]), out)


class PoiseComplete(_Node):
    """The motion between keyframes is made, and a simulated body does it."""

    RETURN_TYPES = ("STRING", "STRING", "STRING")
    RETURN_NAMES = ("motion", "report", "told")

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:  # noqa: N802
        """See ComfyUI."""
        keys = ("STRING", {"default": "0,30,60", "tooltip": "Frames that stay, counted from 0"})
        more = {"fps": _FPS, "format": (FORMATS,)}
        return {"required": {"motion": _MOTION, "keyframes": keys}, "optional": more}

    def run(
        self, motion: str, keyframes: str, fps: float = 0.0, format: str = ".bvh"
    ) -> tuple[str, str, str]:
        """The motion's path, that of its report, and how it went."""
        clip = given(motion)
        out = fresh(clip, "complete", format)
        keys = ",".join(keyframes.replace(",", " ").split())
        words = ["complete", str(clip), "--keyframes", keys, "-o", str(out)]
        return _simulated(answer_of([*words, *_reading(fps)]), out)


class PoiseOpen(_Node):
    """The motion on the page for animators, in the browser of this machine."""

    RETURN_TYPES = ("STRING",)
    RETURN_NAMES = ("motion",)
    OUTPUT_NODE = True

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:  # noqa: N802
        """See ComfyUI."""
        return {"required": {"motion": _MOTION}, "optional": {"fps": _FPS}}

    def run(self, motion: str, fps: float = 0.0) -> tuple[str]:
        """The same path; the page opens by itself, and its server ends when it is closed."""
        clip = given(motion)
        project = fresh(clip, "open", ".project")
        words = ["open", str(clip), "--project", str(project), "--port", "0", "--once"]
        begin([*words, *_reading(fps)])
        return (str(clip),)


class PoiseConvert(_Node):
    """A motion as a file of another format."""

    RETURN_TYPES = ("STRING",)
    RETURN_NAMES = ("motion",)

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:  # noqa: N802
        """See ComfyUI."""
        return {"required": {"motion": _MOTION, "format": (FORMATS,)}, "optional": {"fps": _FPS}}

    def run(self, motion: str, format: str, fps: float = 0.0) -> tuple[str]:
        """The new file's path."""
        clip = given(motion)
        out = fresh(clip, "convert", format)
        answer_of(["convert", str(clip), str(out), *_reading(fps)])
        return (str(out),)


class PoiseFromSMPL(_Node):
    """SMPL parameters of pose estimators as a motion file."""

    RETURN_TYPES = ("STRING",)
    RETURN_NAMES = ("motion",)

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:  # noqa: N802
        """See ComfyUI."""
        rate = ("FLOAT", {"default": 30.0, "min": 0.1, "max": 1000.0, "tooltip": "Of the video"})
        return {"required": {"smpl_params": ("SMPL_PARAMS",), "fps": rate}}

    @classmethod
    def IS_CHANGED(cls, **_: Any) -> str:  # noqa: N802
        """What comes in says it."""
        return ""

    def run(self, smpl_params: dict[str, Any], fps: float) -> tuple[str]:
        """The path of an npz. Of parameters for world and camera those for the world are taken."""
        import numpy as np

        parts = smpl_params.get("global", smpl_params)
        named = ("global_orient", "body_pose", "transl", "betas")
        missing = [name for name in named[:3] if name not in parts]
        if missing:
            raise RuntimeError(f"The SMPL parameters lack {', '.join(missing)}")
        arrays = {name: _array(parts[name]) for name in named if name in parts}
        frames = len(arrays["transl"])
        arrays |= {k: v.reshape(frames, -1) for k, v in arrays.items() if k != "betas"}
        out = fresh(Path("smpl"), "motion", ".npz")
        np.savez(out, fps=fps, **arrays)
        return (str(out),)


def _array(values: Any) -> Any:
    """Numbers as an array; tensors of torch may lie on a GPU."""
    import numpy as np

    return np.asarray(values.detach().cpu() if hasattr(values, "detach") else values, dtype=float)


def _simulated(answer: dict[str, Any], out: Path) -> tuple[str, str, str]:
    written = answer.get("outputs") or {}
    report = written.get("report", out.with_suffix("") / "report.html")
    return str(out), str(report), str((answer.get("result") or {}).get("sentence", ""))


_NODES = {
    PoiseInfo: "Poise: what a motion holds",
    PoiseDoctor: "Poise: motion doctor",
    PoiseTrack: "Poise: track with a body",
    PoiseComplete: "Poise: complete keyframes",
    PoiseOpen: "Poise: open in Poise",
    PoiseConvert: "Poise: convert",
    PoiseFromSMPL: "Poise: from SMPL parameters",
}
NODE_CLASS_MAPPINGS = {node.__name__: node for node in _NODES}
NODE_DISPLAY_NAME_MAPPINGS = {node.__name__: name for node, name in _NODES.items()}
