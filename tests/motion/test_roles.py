"""Names and trees of many makers become the same roles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from poise.errors import PoiseError
from poise.formats import read_clip
from poise.motion import Skeleton, find_roles
from poise.motion.role_words import name_words
from poise.motion.roles import check_role, split_role
from refusals import refused

SIDED = ("clavicle", "upper_arm", "forearm", "hand", "thigh", "shin", "foot", "toes")


def tree(text: str) -> Skeleton:
    """A skeleton of "name<parent" words; without a parent a joint hangs on the one before it."""
    names: list[str] = []
    parents: list[int] = []
    for word in text.split():
        name, _, parent = word.replace("~", " ").partition("<")
        parents.append(names.index(parent) if parent else len(names) - 1)
        names.append(name)
    offsets = np.tile([0.0, 0.0, 0.1], (len(names), 1))
    offsets[0] = 0.0
    return Skeleton(tuple(names), tuple(parents), offsets)


def sides(text: str, left: str, right: str) -> str:
    """The words for the left side and again for the right one; {} is the side."""
    return text.replace("{}", left) + " " + text.replace("{}", right)


def named(pattern: str, parts: str) -> tuple[str, ...]:
    """Names by a pattern of one maker."""
    return tuple(pattern.format(part) for part in parts.split())


MIXAMO_SIDE = (
    "mixamorig:{}Shoulder<mixamorig:Spine2 mixamorig:{}Arm mixamorig:{}ForeArm mixamorig:{}Hand "
    "mixamorig:{}HandThumb1 mixamorig:{}HandThumb2 mixamorig:{}HandIndex1<mixamorig:{}Hand "
    "mixamorig:{}HandIndex2 mixamorig:{}UpLeg<mixamorig:Hips mixamorig:{}Leg mixamorig:{}Foot "
    "mixamorig:{}ToeBase mixamorig:{}Toe_End"
)
UNREAL_SIDE = (
    "clavicle_{}<spine_03 upperarm_{} upperarm_twist_01_{} lowerarm_{}<upperarm_{} "
    "lowerarm_twist_01_{} hand_{}<lowerarm_{} index_metacarpal_{} index_01_{} index_02_{} "
    "thumb_01_{}<hand_{} thigh_{}<pelvis thigh_twist_01_{} calf_{}<thigh_{} calf_twist_01_{} "
    "foot_{}<calf_{} ball_{} ik_foot_{}<ik_foot_root"
)
VROID_SIDE = (
    "J_Bip_{}_Shoulder<J_Bip_C_UpperChest J_Bip_{}_UpperArm J_Bip_{}_LowerArm J_Bip_{}_Hand "
    "J_Bip_{}_Little1 J_Bip_{}_UpperLeg<J_Bip_C_Hips J_Bip_{}_LowerLeg J_Bip_{}_Foot J_Bip_{}_ToeBase "
    "J_Sec_{}_Bust1<J_Bip_C_UpperChest"
)
VRM_SIDE = (
    "{}Shoulder<upperChest {}UpperArm {}LowerArm {}Hand {}ThumbMetacarpal {}ThumbProximal "
    "{}UpperLeg<hips {}LowerLeg {}Foot {}Toes"
)
SMPL_SIDE = (
    "{}_Hip<Pelvis {}_Knee {}_Ankle {}_Foot {}_Collar<Spine3 {}_Shoulder {}_Elbow {}_Wrist {}_Hand"
)
SMPLX_SIDE = (
    "{}_hip<pelvis {}_knee {}_ankle {}_foot {}_collar<spine3 {}_shoulder {}_elbow {}_wrist {}_index1 "
    "{}_index2 {}_thumb1<{}_wrist"
)
BIPED_SIDE = (
    "Bip01~{}~Thigh<Bip01~Pelvis Bip01~{}~Calf Bip01~{}~Foot Bip01~{}~Toe0 Bip01~{}~Toe0Nub "
    "Bip01~{}~Clavicle<Bip01~Spine1 Bip01~{}~UpperArm Bip01~{}~Forearm Bip01~{}~Hand Bip01~{}~Finger0 "
    "Bip01~{}~Finger01 Bip01~{}~Finger1<Bip01~{}~Hand"
)
RIGIFY_SIDE = (
    "DEF-shoulder.{}<DEF-spine.003 DEF-upper_arm.{} DEF-upper_arm.{}.001 DEF-forearm.{} DEF-hand.{} "
    "DEF-thigh.{}<DEF-spine DEF-shin.{} DEF-foot.{} DEF-toe.{}"
)

#: Text, convention, spine, neck, head, and the left side's joints in the order of `SIDED`.
MAKERS = {
    "mixamo": (
        "mixamorig:Hips mixamorig:Spine mixamorig:Spine1 mixamorig:Spine2 mixamorig:Neck mixamorig:Head "
        "mixamorig:HeadTop_End " + sides(MIXAMO_SIDE, "Left", "Right"),
        "Mixamo or MotionBuilder",
        (3, 1, "mixamorig:Head"),
        named("mixamorig:Left{}", "Shoulder Arm ForeArm Hand UpLeg Leg Foot ToeBase"),
    ),
    "unreal": (
        "root pelvis spine_01 spine_02 spine_03 neck_01 head ik_foot_root<root ik_hand_root<root "
        "ik_hand_gun ik_hand_l " + sides(UNREAL_SIDE, "l", "r"),
        "Unreal mannequin",
        (3, 1, "head"),
        named("{}_l", "clavicle upperarm lowerarm hand thigh calf foot ball"),
    ),
    "vroid": (
        "Root J_Bip_C_Hips J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest J_Bip_C_Neck J_Bip_C_Head "
        "J_Adj_L_FaceEye J_Sec_Hair1_01<J_Bip_C_Head " + sides(VROID_SIDE, "L", "R"),
        "VRM (VRoid)",
        (3, 1, "J_Bip_C_Head"),
        named("J_Bip_L_{}", "Shoulder UpperArm LowerArm Hand UpperLeg LowerLeg Foot ToeBase"),
    ),
    "vrm": (
        "hips spine chest upperChest neck head jaw leftEye<head " + sides(VRM_SIDE, "left", "right"),
        "VRM (humanoid bones)",
        (3, 1, "head"),
        named("left{}", "Shoulder UpperArm LowerArm Hand UpperLeg LowerLeg Foot Toes"),
    ),
    "smpl": (
        "Pelvis Spine1 Spine2 Spine3 Neck Head " + sides(SMPL_SIDE, "L", "R"),
        "SMPL",
        (3, 1, "Head"),
        named("L_{}", "Collar Shoulder Elbow Wrist Hip Knee Ankle Foot"),
    ),
    "smplx": (
        "pelvis spine1 spine2 spine3 neck head jaw left_eye_smplhf<head "
        + sides(SMPLX_SIDE, "left", "right"),
        "SMPL-X",
        (3, 1, "head"),
        named("left_{}", "collar shoulder elbow wrist hip knee ankle foot"),
    ),
    "biped": (
        "Bip01 Bip01~Pelvis Bip01~Spine Bip01~Spine1 Bip01~Neck Bip01~Head "
        + sides(BIPED_SIDE, "L", "R"),
        "3ds Max Biped",
        (2, 1, "Bip01 Head"),
        named("Bip01 L {}", "Clavicle UpperArm Forearm Hand Thigh Calf Foot Toe0"),
    ),
    "rigify": (
        "DEF-spine DEF-spine.001 DEF-spine.002 DEF-spine.003 DEF-neck DEF-head "
        + sides(RIGIFY_SIDE, "L", "R"),
        "Rigify",
        (3, 1, "DEF-head"),
        named("DEF-{}.L", "shoulder upper_arm forearm hand thigh shin foot toe"),
    ),
}


@pytest.mark.parametrize("maker", MAKERS)
def test_the_names_of_each_maker_are_understood(maker: str) -> None:
    text, convention, (spine, neck, head), left = MAKERS[maker]
    skeleton = tree(text)
    roles = find_roles(skeleton)
    assert roles.missing() == ()
    assert roles.convention == convention
    found = {kind: roles.joint(f"left_{kind}") for kind in SIDED}
    names = {k: None if j is None else skeleton.names[j] for k, j in found.items()}
    assert names == dict(zip(SIDED, left, strict=True))
    mirror = {k: roles.joint(f"right_{k}") for k in SIDED}
    assert None not in mirror.values() and not set(mirror.values()) & set(found.values())
    assert (len(roles.chain("spine")), len(roles.chain("neck"))) == (spine, neck)
    assert roles.joint("head") == skeleton.index(head)


def test_helpers_and_fingers_are_told_apart() -> None:
    roles = find_roles(tree(MAKERS["unreal"][0]))
    names = roles.skeleton.names
    helpers = {n for j, n in enumerate(names) if roles.role(j) is None}
    assert {"root", "ik_foot_root", "ik_foot_l", "ik_hand_gun", "thigh_twist_01_r"} <= helpers
    assert names[roles.joint("left_index0") or 0] == "index_metacarpal_l"
    assert names[roles.joint("left_index2") or 0] == "index_02_l"
    biped = find_roles(tree(MAKERS["biped"][0]))
    assert biped.skeleton.names[biped.joint("left_thumb2") or 0] == "Bip01 L Finger01"
    assert biped.skeleton.names[biped.joint("left_index1") or 0] == "Bip01 L Finger1"


#: Clip of the data folder, convention, and the left clavicle, upper arm, hand, thigh, foot, toes.
CLIPS = {
    "cmu_amc/02/02_01.amc": ("CMU (ASF)", "lclavicle lhumerus lwrist lfemur lfoot ltoes"),
    "cmu_bvh/acrnn_salsa/01.bvh": ("CMU (BVH, Poser)", "lCollar lShldr lHand lThigh lFoot -"),
    "cmu_bvh/ad/jumping_jacks.bvh": (
        "CMU (BVH, 3ds Max)",
        "LeftCollar LeftShoulder LeftWrist LeftHip LeftAnkle LeftToe",
    ),
    "cmu_bvh/fairmotion/01_01.bvh": (
        "CMU (BVH, MotionBuilder)",
        "LeftShoulder LeftArm LeftHand LeftUpLeg LeftFoot LeftToeBase",
    ),
    "cmu_bvh/ad/dance001.bvh": ("", "lclavicle lhumerus lhand lfemur lfoot ltoes"),
    "lafan1_bvh/walk4_subject1.bvh": (
        "LAFAN1",
        "LeftShoulder LeftArm LeftHand LeftUpLeg LeftFoot LeftToe",
    ),
    "other/bandai_bvh/dataset-1_bow_active_001.bvh": (
        "Bandai Namco",
        "Shoulder_L UpperArm_L Hand_L UpperLeg_L Foot_L Toes_L",
    ),
    "deepmimic_txt/humanoid3d_walk.txt": (
        "DeepMimic",
        "- left_shoulder left_wrist left_hip left_ankle -",
    ),
    "other/xsens_bvh/251021_04_boxing_120Hz_cm_3DsMax.bvh": (
        "Xsens",
        "LeftCollar LeftShoulder LeftWrist LeftHip LeftAnkle LeftToe",
    ),
}


@pytest.mark.parametrize("name", CLIPS)
def test_the_skeletons_of_real_clips_are_understood(name: str, data_dir) -> None:
    convention, listed = CLIPS[name]
    skeleton = read_clip(data_dir / name).skeleton
    roles = find_roles(skeleton)
    assert roles.convention == convention and roles.missing() == ()
    kinds = ("clavicle", "upper_arm", "hand", "thigh", "foot", "toes")
    found = [roles.joint(f"left_{k}") for k in kinds]
    assert ["-" if j is None else skeleton.names[j] for j in found] == listed.split()


@pytest.mark.parametrize(
    ("name", "side", "core"),
    [
        ("mixamorig:LeftUpLeg", "left", "upleg"),
        ("mixamorig9:RightHand", "right", "hand"),
        ("Character1_LeftArm", "left", "arm"),
        ("lfemur", "left", "femur"),
        ("LHipJoint", "left", "hipjoint"),
        ("lShldr", "left", "shldr"),
        ("upperarm_l", "left", "upperarm"),
        ("J_Bip_R_UpperArm", "right", "upperarm"),
        ("Bip01 L Thigh", "left", "thigh"),
        ("thigh.L.001", "left", "thigh"),
        ("m_avg_R_Knee", "right", "knee"),
        ("lowerback", "", "lowerback"),
        ("leg", "", "leg"),
        ("root", "", "root"),
        ("rig", "", "rig"),
    ],
)
def test_names_come_apart_into_side_and_part(name: str, side: str, core: str) -> None:
    words = name_words(name)
    assert (words.side, words.core) == (side, core)


def test_a_shoulder_is_what_the_rest_of_the_arm_makes_it() -> None:
    legs = " LeftHip<Hips LeftKnee LeftAnkle RightHip<Hips RightKnee RightAnkle"
    arm = find_roles(tree("Hips Chest LeftShoulder LeftElbow LeftWrist" + legs))
    assert arm.role(arm.skeleton.index("LeftShoulder")) == "left_upper_arm"
    clavicle = find_roles(tree("Hips Chest LeftShoulder LeftArm LeftForeArm LeftHand" + legs))
    assert clavicle.role(clavicle.skeleton.index("LeftShoulder")) == "left_clavicle"
    assert clavicle.rows[-1].confidence == 1.0
    sure = {r.role: r.confidence for r in clavicle.rows}
    assert sure["left_clavicle"] < sure["left_upper_arm"] == 1.0


def test_a_joint_without_a_telling_name_gets_its_part_by_its_place() -> None:
    roles = find_roles(tree("Hips LeftA LeftB LeftFoot RightA<Hips RightB RightFoot"))
    assert [roles.role(j) for j in (1, 2, 3)] == ["left_thigh", "left_shin", "left_foot"]
    row = next(r for r in roles.rows if r.role == "left_shin")
    assert row.confidence < 0.5 and "above the foot" in row.evidence


def test_what_is_stated_overrules_what_is_guessed() -> None:
    skeleton = tree("a b c d e<a f g")
    assert find_roles(skeleton).rows == ()
    stated = {
        "a": "hips",
        **{"b": "left_thigh", "c": "left_shin", "d": "left_foot"},
        **{"e": "right_thigh", "f": "right_shin", "g": "right_foot"},
    }
    roles = find_roles(skeleton, stated)
    assert {roles.skeleton.names[r.joint]: r.role for r in roles.rows} == stated
    assert {r.evidence for r in roles.rows} == {"you said so"}


def test_missing_parts_are_named_with_those_found_and_what_to_do() -> None:
    arm = "LeftArm LeftForeArm LeftHand"
    roles = find_roles(tree(f"Hips Spine {arm} RightUpLeg<Hips RightLeg RightFoot"))
    with pytest.raises(PoiseError) as refused:
        roles.require()
    said = str(refused.value)
    assert "left_thigh, left_shin, left_foot" in said and "right_thigh=RightUpLeg" in said
    assert "--map JOINT=" in said


def test_wrong_statements_are_refused() -> None:
    skeleton = tree("Hips LeftLeg LeftFoot")
    with refused("unknown-role", says=("left_tigh", "left_thigh")):
        find_roles(skeleton, {"Hips": "left_tigh"})
    with refused("unknown-joint", says="Hip"):
        find_roles(skeleton, {"Hip": "hips"})
    with refused("role-conflict", says=("LeftLeg", "LeftFoot")):
        find_roles(skeleton, {"LeftLeg": "left_shin", "LeftFoot": "left_shin"})
    for bad in ("thigh", "left_hips", "left_thumb", "left_spine1"):
        with refused("unknown-role"):
            check_role(bad)
    for good in ("hips", "spine4", "left_thumb0", "right_upper_arm", "head"):
        assert check_role(good) == good
    assert split_role("left_upper_arm") == ("left", "upper_arm") and split_role("neck2") == ("", "neck")


_WORDS = st.sampled_from(
    [
        "Left",
        "right",
        "l_",
        "R.",
        "Hip",
        "leg",
        "Foot",
        "hand",
        "Arm",
        "Spine",
        "1",
        "02",
        "Twist",
        " ",
        "ü",
    ]
)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.lists(_WORDS, min_size=1, max_size=4).map("".join), min_size=1, max_size=25), st.data()
)
def test_any_names_on_any_tree_give_roles_or_none(words: list[str], data: st.DataObject) -> None:
    names = tuple(f"{w}#{j}" for j, w in enumerate(words))
    parents = tuple(-1 if j == 0 else data.draw(st.integers(0, j - 1)) for j in range(len(names)))
    skeleton = Skeleton(names, parents, np.ones((len(names), 3)))
    roles = find_roles(skeleton)
    joints = [r.joint for r in roles.rows]
    assert len(set(joints)) == len(joints) and len({r.role for r in roles.rows}) == len(joints)
    assert all(0 < r.confidence <= 1 and r.evidence for r in roles.rows)
    # A thigh carries its shin, and a shin its foot.
    for side in ("left", "right"):
        for upper, lower in (("thigh", "shin"), ("shin", "foot")):
            a, b = roles.joint(f"{side}_{upper}"), roles.joint(f"{side}_{lower}")
            while a is not None and b is not None and b != a:
                b = parents[b]
                assert b >= a


def test_a_chain_of_many_joints_is_read() -> None:
    names = ("LeftUpLeg", *(f"LeftPart{i}" for i in range(1500)), "LeftFoot")
    chain = Skeleton(names, tuple(range(-1, len(names) - 1)), np.ones((len(names), 3)))
    assert find_roles(chain).joint("left_foot") in (None, len(names) - 1)
