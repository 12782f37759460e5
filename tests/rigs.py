"""Humans with any rig's names and rest pose, made in code: twist bones, fingers, helpers, own frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from poise.motion import Clip, Skeleton
from poise.motion.rotations import quat_conj, quat_mul, quat_rotate, rotvec_to_quat

#: role, parent role, offset (m, facing +x, left is +y, arms hanging).
_MIDDLE = (
    ("pelvis", "", (0, 0, 0)),
    ("spine", "pelvis", (0, 0, 0.12)),
    ("chest", "spine", (0, 0, 0.2)),
    ("neck", "chest", (0, 0, 0.22)),
    ("head", "neck", (0.01, 0, 0.1)),
)
_SIDE = (
    ("thigh", "pelvis", (0, 0.1, -0.02)),
    ("shin", "thigh", (0, 0, -0.42)),
    ("foot", "shin", (0, 0, -0.4)),
    ("toe", "foot", (0.13, 0, -0.05)),
    ("clavicle", "chest", (0, 0.03, 0.17)),
    ("upper_arm", "clavicle", (0, 0.15, 0)),
    ("forearm", "upper_arm", (0, 0, -0.29)),
    ("hand", "forearm", (0, 0, -0.25)),
    ("finger1", "hand", (0, 0, -0.09)),
    ("finger2", "finger1", (0, 0, -0.04)),
    ("thumb1", "hand", (0.04, 0, -0.03)),
    ("thumb2", "thumb1", (0.02, 0, -0.03)),
)
_TWISTED = ("upper_arm", "forearm", "thigh")

#: Names by role; "{S}" is the side as the rig writes it.
STYLES: dict[str, tuple[tuple[str, str], dict[str, str]]] = {
    "mixamo": (("Left", "Right"), dict(
        pelvis="mixamorig:Hips", spine="mixamorig:Spine", chest="mixamorig:Spine1",
        neck="mixamorig:Neck", head="mixamorig:Head", thigh="mixamorig:{S}UpLeg",
        shin="mixamorig:{S}Leg", foot="mixamorig:{S}Foot", toe="mixamorig:{S}ToeBase",
        clavicle="mixamorig:{S}Shoulder", upper_arm="mixamorig:{S}Arm",
        forearm="mixamorig:{S}ForeArm", hand="mixamorig:{S}Hand",
        finger="mixamorig:{S}HandIndex", thumb="mixamorig:{S}HandThumb",
        twist="{N}Twist")),
    "unreal": (("l", "r"), dict(
        pelvis="pelvis", spine="spine_01", chest="spine_02", neck="neck_01", head="head",
        thigh="thigh_{S}", shin="calf_{S}", foot="foot_{S}", toe="ball_{S}", clavicle="clavicle_{S}",
        upper_arm="upperarm_{S}", forearm="lowerarm_{S}", hand="hand_{S}", finger="index_0{S}",
        thumb="thumb_0{S}", twist="{N}_twist_01")),
    "vrm": (("L", "R"), dict(
        pelvis="J_Bip_C_Hips", spine="J_Bip_C_Spine", chest="J_Bip_C_Chest", neck="J_Bip_C_Neck",
        head="J_Bip_C_Head", thigh="J_Bip_{S}_UpperLeg", shin="J_Bip_{S}_LowerLeg",
        foot="J_Bip_{S}_Foot", toe="J_Bip_{S}_ToeBase", clavicle="J_Bip_{S}_Shoulder",
        upper_arm="J_Bip_{S}_UpperArm", forearm="J_Bip_{S}_LowerArm", hand="J_Bip_{S}_Hand",
        finger="J_Bip_{S}_Index", thumb="J_Bip_{S}_Thumb", twist="{N}_Twist")),
    "smpl": (("L", "R"), dict(
        pelvis="Pelvis", spine="Spine1", chest="Spine2", neck="Neck", head="Head", thigh="{S}_Hip",
        shin="{S}_Knee", foot="{S}_Ankle", toe="{S}_Foot", clavicle="{S}_Collar",
        upper_arm="{S}_Shoulder", forearm="{S}_Elbow", hand="{S}_Wrist", finger="{S}_Hand",
        thumb="{S}_Thumb", twist="{N}_twist")),
    "smplx": (("left", "right"), dict(
        pelvis="pelvis", spine="spine1", chest="spine2", neck="neck", head="head", thigh="{S}_hip",
        shin="{S}_knee", foot="{S}_ankle", toe="{S}_foot", clavicle="{S}_collar",
        upper_arm="{S}_shoulder", forearm="{S}_elbow", hand="{S}_wrist", finger="{S}_index",
        thumb="{S}_thumb", twist="{N}_twist")),
    "bandai": (("L", "R"), dict(
        pelvis="Hips", spine="Spine", chest="Chest", neck="Neck", head="Head", thigh="UpperLeg_{S}",
        shin="LowerLeg_{S}", foot="Foot_{S}", toe="Toes_{S}", clavicle="Shoulder_{S}",
        upper_arm="UpperArm_{S}", forearm="LowerArm_{S}", hand="Hand_{S}", finger="Index_{S}",
        thumb="Thumb_{S}", twist="{N}_Twist")),
    "xsens": (("Left", "Right"), dict(
        pelvis="Hips", spine="Chest", chest="Chest2", neck="Neck", head="Head", thigh="{S}Hip",
        shin="{S}Knee", foot="{S}Ankle", toe="{S}Toe", clavicle="{S}Collar",
        upper_arm="{S}Shoulder", forearm="{S}Elbow", hand="{S}Wrist", finger="{S}Finger",
        thumb="{S}Thumb", twist="{N}Twist")),
    "biped": (("L", "R"), dict(
        pelvis="Bip01 Pelvis", spine="Bip01 Spine", chest="Bip01 Spine1", neck="Bip01 Neck",
        head="Bip01 Head", thigh="Bip01 {S} Thigh", shin="Bip01 {S} Calf", foot="Bip01 {S} Foot",
        toe="Bip01 {S} Toe0", clavicle="Bip01 {S} Clavicle", upper_arm="Bip01 {S} UpperArm",
        forearm="Bip01 {S} Forearm", hand="Bip01 {S} Hand", finger="Bip01 {S} Finger",
        thumb="Bip01 {S} Thumb", twist="{N}Twist")),
    "daz": (("l", "r"), dict(
        pelvis="hip", spine="abdomenLower", chest="chestUpper", neck="neckLower", head="head",
        thigh="{S}ThighBend", shin="{S}Shin", foot="{S}Foot", toe="{S}Metatarsals",
        clavicle="{S}Collar", upper_arm="{S}ShldrBend", forearm="{S}ForearmBend", hand="{S}Hand",
        finger="{S}Index", thumb="{S}Thumb", twist="{N}_Twist")),
    "blender": (("L", "R"), dict(
        pelvis="DEF-spine", spine="DEF-spine.001", chest="DEF-spine.003", neck="DEF-neck",
        head="DEF-head", thigh="DEF-thigh.{S}", shin="DEF-shin.{S}", foot="DEF-foot.{S}",
        toe="DEF-toe.{S}", clavicle="DEF-shoulder.{S}", upper_arm="DEF-upper_arm.{S}",
        forearm="DEF-forearm.{S}", hand="DEF-hand.{S}", finger="DEF-f_index.{S}",
        thumb="DEF-thumb.{S}", twist="{N}.001")),
    "character creator": (("L", "R"), dict(
        pelvis="CC_Base_Hip", spine="CC_Base_Waist", chest="CC_Base_Spine02",
        neck="CC_Base_NeckTwist01", head="CC_Base_Head", thigh="CC_Base_{S}_Thigh",
        shin="CC_Base_{S}_Calf", foot="CC_Base_{S}_Foot", toe="CC_Base_{S}_ToeBase",
        clavicle="CC_Base_{S}_Clavicle", upper_arm="CC_Base_{S}_Upperarm",
        forearm="CC_Base_{S}_Forearm", hand="CC_Base_{S}_Hand", finger="CC_Base_{S}_Index",
        thumb="CC_Base_{S}_Thumb", twist="{N}Twist01")),
    "numbers": (("a", "b"), {}),
}  # fmt: skip


@dataclass(frozen=True)
class Rig:
    """A skeleton, the joint of every role ("thigh left"), and the local rotations in which it stands
    with hanging arms, `(J, 4)` wxyz."""

    skeleton: Skeleton
    roles: dict[str, int]
    standing: np.ndarray

    def clip(self, seed: int = 0, frames: int = 20, size: float = 0.15) -> Clip:
        """A smooth random motion of every channel around the standing pose."""
        rng = np.random.default_rng(seed)
        t = np.linspace(0, 2 * np.pi, frames)[:, None, None]
        count = len(self.skeleton)
        wave = np.sin(t + rng.uniform(0, 6, (1, count, 3))) * rng.uniform(0, size, (1, count, 3))
        base = torch.tensor(self.standing).expand(frames, -1, -1)
        rot = quat_mul(base, rotvec_to_quat(torch.tensor(wave))).numpy()
        pos = np.tile([0.0, 0.0, 0.95], (frames, 1)) + 0.02 * np.sin(t[:, 0])
        return Clip(self.skeleton, pos, rot, 30.0, "random")


def rig(
    style: str = "mixamo",
    pose: str = "I",
    twist: str = "none",
    fingers: bool = False,
    helpers: bool = False,
    scale: float = 1.0,
    seed: int = 1,
) -> Rig:
    """A human with 21 to about 40 joints.

    pose: arms of the rest pose: "I" hanging, "A", "T", or "folded", where every joint has a frame of
    its own and identity is no pose of a human. twist: "none", "side" (leaves beside the limb) or "chain"
    (between shoulder and elbow, elbow and hand, hip and knee). helpers: a root above the pelvis and IK
    targets before everything else.
    """
    rows = _rows(twist, fingers)
    roles = [r for r, _, _ in rows]
    names = [_name(style, r, i) for i, r in enumerate(roles)]
    parents = [roles.index(p) if p else -1 for _, p, _ in rows]
    offsets = np.array([o for _, _, o in rows], dtype=float) * scale
    if helpers:
        names = ["root", "ik_foot_root", "ik_foot_l", "ik_foot_r", "ik_hand_l", "ik_hand_r", *names]
        parents = [-1, 0, 1, 1, 0, 0, *(p + 6 if p >= 0 else 0 for p in parents)]
        offsets = np.concatenate((np.zeros((6, 3)), offsets))
        roles = ["", "", "", "", "", "", *roles]
    # World rotations of the rest pose's frames against those of the hanging pose.
    rng = np.random.default_rng(seed)
    local = np.zeros((len(names), 4))
    local[:, 0] = 1.0
    angle = {"I": 0.0, "A": 45.0, "T": 90.0, "folded": 0.0}[pose]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        # The standing clip turns a raised arm down again.
        j = roles.index(f"upper_arm {side}")
        local[j] = _quat([-sign * np.deg2rad(angle), 0, 0])
    if pose == "folded":
        for j in range(1, len(names)):
            local[j] = _quat(rng.normal(size=3))
    world = np.zeros_like(local)
    for j, parent in enumerate(parents):
        world[j] = local[j] if parent < 0 else _mul(world[parent], local[j])
    # Offsets in the parents' frames, so that the local rotations above give the hanging pose.
    turned = [
        o if p < 0 else quat_rotate(quat_conj(torch.tensor(world[p])), torch.tensor(o)).numpy()
        for o, p in zip(offsets, parents, strict=True)
    ]
    skeleton = Skeleton(tuple(names), tuple(parents), np.array(turned))
    if pose == "folded":
        skeleton = skeleton.with_source(format="bvh")
    return Rig(skeleton, {r: i for i, r in enumerate(roles) if r}, local)


def _rows(twist: str, fingers: bool) -> list[tuple[str, str, tuple]]:
    rows: list[tuple[str, str, tuple]] = list(_MIDDLE)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for role, parent, (x, y, z) in _SIDE:
            if not fingers and role.startswith(("finger", "thumb")):
                continue
            above = parent if parent in ("pelvis", "chest") else f"{parent} {side}"
            at: tuple = (x, sign * y, z)
            if twist == "chain" and parent in _TWISTED:
                above, at = f"{parent} twist {side}", (x / 2, sign * y / 2, z / 2)
            rows.append((f"{role} {side}", above, at))
            if twist != "none" and role in _TWISTED:
                below = next(o for r, p, o in _SIDE if p == role)
                half = (below[0] / 2, sign * below[1] / 2, below[2] / 2)
                rows.append((f"{role} twist {side}", f"{role} {side}", half))
    return rows


def _name(style: str, role: str, index: int) -> str:
    sides, table = STYLES[style]
    if not table:
        return f"bone{index:02d}"
    side = sides["right" in role]
    kind = role.replace(" left", "").replace(" right", "")
    if kind.endswith(" twist"):
        own = table[kind.removesuffix(" twist")].format(S=side)
        return table["twist"].format(N=own, S=side)
    if kind[:-1] in ("finger", "thumb"):
        return table[kind[:-1]].format(S=side) + kind[-1]
    return table[kind].format(S=side)


def _quat(rotvec: list | np.ndarray) -> np.ndarray:
    return rotvec_to_quat(torch.tensor(np.asarray(rotvec, dtype=float))).numpy()


def _mul(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return quat_mul(torch.tensor(a), torch.tensor(b)).numpy()
