"""Every dialect of joint names yields a whole human."""

from __future__ import annotations

import re

import numpy as np
import pytest

from poise.body import find_anatomy, generate_table, make_humanoid
from poise.motion import Skeleton
from poise.motion.role_words import without_rig
from refusals import refused
from toy_human import human

#: Hierarchies as their files have them, and how many spine, neck, head and clavicle parts they hold.
DIALECTS = {
    "cmu asf": (
        "root(lhipjoint(lfemur(ltibia(lfoot(ltoes)))) rhipjoint(rfemur(rtibia(rfoot(rtoes))))"
        " lowerback(upperback(thorax(lowerneck(upperneck(head))"
        " lclavicle(lhumerus(lradius(lwrist(lhand(lfingers) lthumb))))"
        " rclavicle(rhumerus(rradius(rwrist(rhand(rfingers) rthumb))))))))",
        (3, 2, 1, 2),
    ),
    "cmu bvh": (
        "Hips(LHipJoint(LeftUpLeg(LeftLeg(LeftFoot(LeftToeBase))))"
        " RHipJoint(RightUpLeg(RightLeg(RightFoot(RightToeBase)))) LowerBack(Spine(Spine1(Neck("
        "Neck1(Head)) LeftShoulder(LeftArm(LeftForeArm(LeftHand(LeftFingerBase(LFingers) LThumb))))"
        " RightShoulder(RightArm(RightForeArm(RightHand(RightFingerBase(RFingers) RThumb))))))))",
        (3, 2, 1, 2),
    ),
    "motionbuilder": (
        "Hips(LHipJoint(LeftHip(LeftKnee(LeftAnkle(LeftToe)))) RHipJoint(RightHip(RightKnee(RightAnkle"
        "(RightToe)))) lowerback(Chest(Chest2(lowerneck(Neck(Head)) LeftCollar(LeftShoulder(LeftElbow("
        "LeftWrist(lhand(LFingers) LThumb)))) RightCollar(RightShoulder(RightElbow(RightWrist(rhand("
        "RFingers) RThumb))))))))",
        (3, 2, 1, 2),
    ),
    "acrnn": (
        "hip(abdomen(chest(neck(head(leftEye rightEye)) rCollar(rShldr(rForeArm(rHand(rThumb1(rThumb2)"
        " rIndex1(rIndex2))))) lCollar(lShldr(lForeArm(lHand(lThumb1(lThumb2) lIndex1(lIndex2)))))))"
        " rButtock(rThigh(rShin(rFoot))) lButtock(lThigh(lShin(lFoot))))",
        (2, 1, 1, 2),
    ),
    "karate": (
        "pelvis(lfemur(ltibia(lfoot(ltoes))) rfemur(rtibia(rfoot(rtoes))) thorax(head lclavicle("
        "lhumerus(lradius(lhand))) rclavicle(rhumerus(rradius(rhand)))))",
        (1, 0, 1, 2),
    ),
    "handspring": (
        "pelvis(lfemur(ltibia(lfoot(ltoes))) rfemur(rtibia(rfoot(rtoes))) lowerback(upperback(lclavicle("
        "lhumerus(lradius(lhand))) rclavicle(rhumerus(rradius(rhand))) LowerNeck(Neck))))",
        (2, 2, 0, 2),
    ),
    "lafan": (
        "Hips(LeftUpLeg(LeftLeg(LeftFoot(LeftToe))) RightUpLeg(RightLeg(RightFoot(RightToe))) Spine("
        "Spine1(Spine2(Neck(Head) LeftShoulder(LeftArm(LeftForeArm(LeftHand))) RightShoulder(RightArm("
        "RightForeArm(RightHand)))))))",
        (3, 1, 1, 2),
    ),
    "bandai": (
        "joint_Root(Hips(Spine(Chest(Neck(Head) Shoulder_L(UpperArm_L(LowerArm_L(Hand_L))) Shoulder_R("
        "UpperArm_R(LowerArm_R(Hand_R))))) UpperLeg_L(LowerLeg_L(Foot_L(Toes_L))) UpperLeg_R(LowerLeg_R("
        "Foot_R(Toes_R)))))",
        (2, 1, 1, 2),
    ),
    "mass": (
        "Character1_Hips(Character1_Spine(Character1_Spine1(Character1_LeftShoulder(Character1_LeftArm("
        "Character1_LeftForeArm(Character1_LeftHand L_Radius_RIGMESH) L_Humerus_RIGMESH)"
        " L_Shoulder_RIGMESH) Character1_RightShoulder(Character1_RightArm(Character1_RightForeArm("
        "Character1_RightHand R_Radius_RIGMESH) R_Humerus_RIGMESH) R_Shoulder_RIGMESH) Character1_Neck("
        "Character1_Head Neck_RIGMESH) Torso_RIGMESH) Spine_RIGMESH) Character1_RightUpLeg("
        "Character1_RightLeg(Character1_RightFoot(Character1_RightToeBase R_Talus_RIGMESH)"
        " R_Tibia_RIGMESH) R_Femur_RIGMESH) Character1_LeftUpLeg(Character1_LeftLeg(Character1_LeftFoot("
        "Character1_LeftToeBase L_Talus_RIGMESH) L_Tibia_RIGMESH) L_Femur_RIGMESH) Pelvis_RIGMESH)",
        (2, 1, 1, 2),
    ),
    "xsens": (
        "Hips(Chest(Chest2(Chest3(Chest4(Neck(Head) RightCollar(RightShoulder(RightElbow(RightWrist)))"
        " LeftCollar(LeftShoulder(LeftElbow(LeftWrist))))))) RightHip(RightKnee(RightAnkle(RightToe)))"
        " LeftHip(LeftKnee(LeftAnkle(LeftToe))))",
        (4, 1, 1, 2),
    ),
    "rokoko": (
        "Hips(Spine(Spine1(Spine2(LeftShoulder(LeftArm(LeftForeArm(LeftHand(LeftInHandIndex(LeftHandIndex1("
        "LeftHandIndex2)) LeftHandThumb1(LeftHandThumb2))))) Neck(Head) RightShoulder(RightArm("
        "RightForeArm(RightHand(RightInHandIndex(RightHandIndex1(RightHandIndex2)) RightHandThumb1("
        "RightHandThumb2)))))))) LeftUpLeg(LeftLeg(LeftFoot(LeftToeBase))) RightUpLeg(RightLeg("
        "RightFoot(RightToeBase))))",
        (3, 1, 1, 2),
    ),
    "smpl": (
        "Pelvis(L_Hip(L_Knee(L_Ankle(L_Toe))) R_Hip(R_Knee(R_Ankle(R_Toe))) Torso(Spine(Chest(Neck(Head)"
        " L_Thorax(L_Shoulder(L_Elbow(L_Wrist(L_Hand))))"
        " R_Thorax(R_Shoulder(R_Elbow(R_Wrist(R_Hand))))))))",
        (3, 1, 1, 2),
    ),
    "mixamo": (
        "mixamorig:Hips(mixamorig:Spine(mixamorig:Neck(mixamorig:Head) mixamorig:LeftArm("
        "mixamorig:LeftForeArm(mixamorig:LeftHand)) mixamorig:RightArm(mixamorig:RightForeArm("
        "mixamorig:RightHand))) mixamorig:LeftUpLeg(mixamorig:LeftLeg(mixamorig:LeftFoot("
        "mixamorig:LeftToeBase))) mixamorig:RightUpLeg(mixamorig:RightLeg(mixamorig:RightFoot)))",
        (1, 1, 1, 0),
    ),
    "unreal": (
        "root(pelvis(spine_01(spine_02(neck_01(head) clavicle_l(upperarm_l(lowerarm_l(hand_l)))"
        " clavicle_r(upperarm_r(lowerarm_r(hand_r)))))"
        " thigh_l(calf_l(foot_l)) thigh_r(calf_r(foot_r))))",
        (2, 1, 1, 2),
    ),
    "biped": (
        "Bip01(Bip01_Pelvis(Bip01_L_Thigh(Bip01_L_Calf(Bip01_L_Foot)) Bip01_R_Thigh(Bip01_R_Calf("
        "Bip01_R_Foot)) Bip01_Spine(Bip01_L_Clavicle(Bip01_L_UpperArm(Bip01_L_Forearm(Bip01_L_Hand)))"
        " Bip01_R_Clavicle(Bip01_R_UpperArm(Bip01_R_Forearm(Bip01_R_Hand))))))",
        (1, 0, 0, 2),
    ),
    "hips beside spine": (
        "Hips(LowerBody(LeftUpLeg(LeftLeg(LeftFoot)) RightUpLeg(RightLeg(RightFoot))) Spine(Head"
        " LeftArm(LeftForeArm(LeftHand)) RightArm(RightForeArm(RightHand))))",
        (1, 0, 1, 0),
    ),
    "deepmimic": (
        "root(chest(neck right_shoulder(right_elbow(right_wrist)) left_shoulder(left_elbow(left_wrist)))"
        " right_hip(right_knee(right_ankle)) left_hip(left_knee(left_ankle)))",
        (1, 1, 0, 0),
    ),
}


def skeleton_of(tree: str) -> Skeleton:
    """A skeleton from nested names; offsets are all 10 cm down."""
    names: list[str] = []
    parents: list[int] = []
    stack = [-1]
    for mark in re.findall(r"[^\s()]+|[()]", tree.replace(" (", "(")):
        if mark == "(":
            stack.append(len(names) - 1)
        elif mark == ")":
            stack.pop()
        else:
            names.append(mark)
            parents.append(stack[-1])
    offsets = np.tile([0.0, 0.0, -0.1], (len(names), 1))
    offsets[0] = 0
    return Skeleton(tuple(names), tuple(parents), offsets)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_every_dialect_has_all_parts(dialect):
    tree, (spine, neck, head, clavicle) = DIALECTS[dialect]
    skeleton = skeleton_of(tree)
    anatomy = find_anatomy(skeleton)
    for kind in ("thigh", "shin", "foot", "upper_arm", "forearm", "hand"):
        for side in ("left", "right"):
            (joint,) = anatomy.of(kind, side)
            mark = skeleton.names[joint].lower()
            right = "right" in mark or mark[0] == "r" or mark.endswith("_r") or "_r_" in mark
            assert right == (side == "right")
    counts = tuple(len(anatomy.of(k)) for k in ("spine", "neck", "head", "clavicle"))
    assert counts == (spine, neck, head, clavicle)
    assert anatomy.parts[0].kind == "pelvis" and len(anatomy.of("pelvis")) == 1
    for side in ("left", "right"):
        (thigh,), (shin,), (foot,) = (anatomy.of(k, side) for k in ("thigh", "shin", "foot"))
        assert skeleton.parents[foot] == shin and skeleton.parents[shin] == thigh
    table = generate_table(skeleton)
    assert [r.parent for r in table.rows].count(-1) == 1 and table.rows[0].parent == -1
    for side, toe in anatomy.toes:
        assert skeleton.parents[toe] == anatomy.of("foot", side)[0]
        assert "toe" in skeleton.names[toe].lower()


def test_parts_are_depth_first_whatever_the_skeletons_order():
    # The toy lists the arms after the legs' roots, so that its own order is not depth first.
    skeleton = human()
    anatomy = find_anatomy(skeleton)
    joints = [p.joint for p in anatomy.parts]
    assert joints != sorted(joints)
    humanoid = make_humanoid(skeleton, generate_table(skeleton))
    assert tuple(humanoid.model.body(i + 1).name for i in range(len(humanoid.bodies))) == humanoid.bodies


def test_what_is_missing_is_told():
    cases = {
        "a(b(c) d(e))": ("role-missing", ("left foot", "a, b, c, d, e")),
        "Hips(LeftLeg(LeftFoot) RightLeg(RightFoot) Spine(LeftHand RightHand))": ("limb-too-short",),
        "Hips(LeftUpLeg(LeftLeg(LeftFoot)) RightUpLeg(RightLeg(RightFoot)) Spine)": (
            "role-missing",
            "left hand",
        ),
    }
    for tree, message in cases.items():
        with refused(*message):
            find_anatomy(skeleton_of(tree))


def test_an_arm_that_hangs_on_a_leg_is_told() -> None:
    tree = (
        "Hips(LeftUpLeg(LeftLeg(LeftFoot) RightArm(RightForeArm(RightHand)))"
        " RightUpLeg(RightLeg(RightFoot))"
        " Spine(Neck(Head) LeftShoulder(LeftArm(LeftForeArm(LeftHand)))))"
    )
    with refused("role-conflict", says="LeftUpLeg"):
        find_anatomy(skeleton_of(tree))


@pytest.mark.parametrize("prefix", ["Armature_", "Armature|", "Armature.001_", "Hero_", "my-rig."])
def test_the_name_of_a_rig_before_the_joints_names(prefix: str) -> None:
    """Blender's exporters write "Armature_Hips"; the rig's own joint may stand above all."""
    for dialect in ("hips beside spine", "unreal", "motionbuilder", "deepmimic"):
        tree = DIALECTS[dialect][0]
        named = re.sub(r"[^\s()]+", lambda m: prefix + m.group(), tree)
        below = f"{prefix.rstrip('_|.')}({named})"
        plain, *others = (
            [(p.kind, p.side) for p in find_anatomy(skeleton_of(t)).parts] for t in (tree, named, below)
        )
        assert others == [plain, plain]


def test_words_that_all_joints_share_stay_where_they_are_a_part() -> None:
    names = ("Hips", "Spine_1", "Spine_2", "Spine_3", "Spine_4", "Spine_5")
    assert without_rig(names) == names and without_rig(names[1:]) == names[1:]
    assert without_rig(("A_x", "A_y")) == ("A_x", "A_y")
