"""VRM's humanoid bones: a file states which node is which part, and names alone tell them too."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from handmade_gltf_files import Gltf, put, turn

from poise.formats import read_clip, write_clip
from poise.motion import Skeleton
from poise.motion.roles import find_roles, map_joints
from toy_human import swing

#: VRM's bones with their parents and places in m, Y up.
BONES = (
    ("hips", None, (0, 0.95, 0)),
    ("spine", "hips", (0, 0.1, 0)),
    ("chest", "spine", (0, 0.15, 0)),
    ("upperChest", "chest", (0, 0.12, 0)),
    ("neck", "upperChest", (0, 0.12, 0)),
    ("head", "neck", (0, 0.08, 0)),
    *(
        (f"{side}{bone}", f"{side}{up}" if up[0].isupper() else up, (x * s, y, z))
        for side, s in (("left", 1), ("right", -1))
        for bone, up, (x, y, z) in (
            ("Shoulder", "upperChest", (0.03, 0.1, 0)),
            ("UpperArm", "Shoulder", (0.12, 0, 0)),
            ("LowerArm", "UpperArm", (0.27, 0, 0)),
            ("Hand", "LowerArm", (0.25, 0, 0)),
            ("IndexProximal", "Hand", (0.08, 0, 0)),
            ("IndexIntermediate", "IndexProximal", (0.03, 0, 0)),
            ("UpperLeg", "hips", (0.09, -0.05, 0)),
            ("LowerLeg", "UpperLeg", (0, -0.42, 0)),
            ("Foot", "LowerLeg", (0, -0.42, 0)),
            ("Toes", "Foot", (0, -0.06, 0.12)),
        )
    ),
)
PLAYED = {
    "hips": "hips", "head": "head", "leftUpperLeg": "left_thigh", "rightLowerLeg": "right_shin",
    "leftFoot": "left_foot", "rightToes": "right_toes", "leftShoulder": "left_clavicle",
    "rightUpperArm": "right_upper_arm", "leftLowerArm": "left_forearm", "rightHand": "right_hand",
    "leftIndexProximal": "left_index1", "rightIndexIntermediate": "right_index2",
}  # fmt: skip


def model(where: str, name_of: dict[str, str]) -> Gltf:
    """A moving body whose nodes have names of no meaning, and what a VRM file says of them."""
    file, at = Gltf(), dict[str, int]()
    for bone, up, place in BONES:
        at[bone] = file.node(name_of[bone], None if up is None else at[up], translation=list(place))
    file.doc["skins"] = [{"joints": list(at.values())}]
    animation = file.animation("wave")
    times = [k / 30 for k in range(6)]
    file.channel(animation, at["hips"], "translation", times, [(0, 0.95, 0.02 * k) for k in range(6)])
    keys = [turn("z", 5.0 * k) for k in range(6)]
    file.channel(animation, at["leftUpperArm"], "rotation", times, keys)
    bones: Any = {bone: {"node": node} for bone, node in at.items()}
    if where == "VRM":
        bones = [{"bone": bone, "node": node} for bone, node in at.items()]
    file.doc["extensions"] = {where: {"humanoid": {"humanBones": bones}}}
    return file


@pytest.mark.parametrize("where", ["VRM", "VRMC_vrm", "VRMC_vrm_animation"])
@pytest.mark.parametrize("suffix", [".vrm", ".vrma", ".glb"])
def test_a_vrm_file_is_believed_whatever_its_nodes_are_called(
    tmp_path: Path, where: str, suffix: str
) -> None:
    called = {bone: f"ボーン{k}" for k, (bone, _, _) in enumerate(BONES)}
    path = put(tmp_path, "a.glb", model(where, called)).rename(tmp_path / f"b{suffix}")
    clip = read_clip(path)
    roles = find_roles(clip.skeleton)
    for bone, role in PLAYED.items():
        joint = roles.joint(role)
        assert joint is not None and clip.skeleton.names[joint] == called[bone], role
    assert len(roles.chain("spine")) == 3 and len(roles.chain("neck")) == 1
    assert "VRM bones say so" in roles.rows[0].evidence
    # It maps onto another body without a word, and a word overrules it.
    rows = map_joints(clip.skeleton, swing().skeleton).rows
    assert sum(row.source is not None for row in rows) >= 15
    other = find_roles(clip.skeleton, {called["neck"]: "head"})
    assert other.joint("head") == clip.skeleton.index(called["neck"])
    # It is still known where the motion came back from a file of another format.
    write_clip(clip, tmp_path / "again.glb")
    assert read_clip(tmp_path / "again.glb").skeleton.names == clip.skeleton.names


def test_what_a_vrm_file_says_wrongly_is_left_out(tmp_path: Path) -> None:
    called = {bone: bone for bone, _, _ in BONES}
    odd: list[Any] = [
        {"bone": "hips", "node": 999}, {"bone": "head", "node": True}, {"bone": 7, "node": 0},
        {"bone": "jaw", "node": 1}, {"bone": "leftHand"}, None, "x",
    ]  # fmt: skip
    for bones in (odd, {"hips": 3, "head": {"node": "1"}, "leftFoot": {"node": [1]}}, 5, None):
        file = model("VRM", called)
        file.doc["extensions"] = {"VRM": {"humanoid": {"humanBones": bones}}, "VRMC_vrm": bones}
        roles = find_roles(read_clip(put(tmp_path, "a.glb", file)).skeleton)
        assert roles.skeleton.names[roles.joint("left_thigh") or 0] == "leftUpperLeg"
    file.doc["extensions"] = ["VRM"]
    assert not find_roles(read_clip(put(tmp_path, "a.glb", file)).skeleton).missing()


@pytest.mark.parametrize(
    ("name_of", "convention"),
    [
        (lambda bone: bone, "VRM (humanoid bones)"),
        (lambda bone: bone[0].upper() + bone[1:], ""),
        (lambda bone: f"Armature|{bone}", ""),
        (
            lambda bone: (
                f"J_Bip_L_{bone[4:]}" if bone.startswith("left")
                else f"J_Bip_R_{bone[5:]}" if bone.startswith("right")
                else f"J_Bip_C_{bone[0].upper()}{bone[1:]}"
            ).replace("Toes", "ToeBase"),
            "VRM (VRoid)",
        ),
    ],
)  # fmt: skip
def test_vrm_names_alone_tell_the_parts(name_of: Any, convention: str) -> None:
    names = [bone for bone, _, _ in BONES]
    parents = tuple(-1 if up is None else names.index(up) for _, up, _ in BONES)
    offsets = [(0, 0, 0), *((z, x, y) for _, _, (x, y, z) in BONES[1:])]
    roles = find_roles(Skeleton(tuple(name_of(n) for n in names), parents, offsets))  # type: ignore[arg-type]
    for bone, role in PLAYED.items():
        assert roles.joint(role) == names.index(bone), role
    assert not convention or roles.convention == convention
