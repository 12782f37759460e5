"""What a VRM file says about its bones: which node is which part of the body, whatever its name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, cast

from poise.motion.io.gltf.file import GltfFile
from poise.motion.io.gltf.tree import Tree

#: Where VRM 1.0, motions of VRM (.vrma) and VRM 0.x hold their humanoid.
_PLACES = ("VRMC_vrm", "VRMC_vrm_animation", "VRM")
_SIDED = {
    "Shoulder": "clavicle", "UpperArm": "upper_arm", "LowerArm": "forearm", "Hand": "hand",
    "UpperLeg": "thigh", "LowerLeg": "shin", "Foot": "foot", "Toes": "toes",
}  # fmt: skip
_FINGERS = {"Index": "index", "Middle": "middle", "Ring": "ring", "Little": "pinky"}
_SEGMENTS = ("Proximal", "Intermediate", "Distal")


def _parts() -> dict[str, str]:
    """The role of each of VRM's bones; of the trunk the ends alone: the rest tells its
    place, as a thumb's segments do, which VRM 0.x and 1.0 name differently."""
    out = {"hips": "hips", "head": "head"}
    for side in ("left", "right"):
        out |= {f"{side}{bone}": f"{side}_{kind}" for bone, kind in _SIDED.items()}
        for finger, kind in _FINGERS.items():
            out |= {f"{side}{finger}{s}": f"{side}_{kind}{n}" for n, s in enumerate(_SEGMENTS, 1)}
    return out


_PARTS = _parts()


def humanoid_of(file: GltfFile, tree: Tree, joints: Sequence[int]) -> dict[int, str]:
    """The roles that a VRM file states, by joint; none where the file is no VRM.

    Of a bone or a joint that is stated twice the first counts; what names no joint is left out.
    """
    out: dict[int, str] = {}
    for bone, node in _bones(file.doc):
        role = _PARTS.get(bone)
        known = isinstance(node, int) and not isinstance(node, bool) and node in joints
        if role is not None and known and role not in out.values():
            out.setdefault(joints.index(node), role)
    return out


def _bones(doc: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """(bone, node) as they are written, unchecked."""
    extensions = _dict(doc.get("extensions"))
    for place in _PLACES:
        bones = _dict(_dict(extensions.get(place)).get("humanoid")).get("humanBones")
        if isinstance(bones, dict):
            for name, bone in cast("dict[str, Any]", bones).items():
                yield name, _dict(bone).get("node")
        elif isinstance(bones, list):
            for bone in cast("list[Any]", bones):
                name = _dict(bone).get("bone")
                if isinstance(name, str):
                    yield name, _dict(bone).get("node")


def _dict(value: Any) -> dict[str, Any]:
    return cast("dict[str, Any]", value) if isinstance(value, dict) else {}
