"""Rotations and rigid transforms: torch, quaternions wxyz, any leading batch dimensions."""

from poise.spatial.rotations import (
    axis_angle_to_quat,
    euler_to_quat,
    heading_quat,
    matrix_to_quat,
    normalize,
    quat_angle,
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_rotate_inv,
    quat_to_euler,
    quat_to_matrix,
    quat_to_rotvec,
    quat_to_sixd,
    rotvec_to_quat,
    slerp,
    unwrap_quats,
)
from poise.spatial.tree import forward_kinematics

__all__ = [
    "axis_angle_to_quat",
    "euler_to_quat",
    "forward_kinematics",
    "heading_quat",
    "matrix_to_quat",
    "normalize",
    "quat_angle",
    "quat_conj",
    "quat_mul",
    "quat_rotate",
    "quat_rotate_inv",
    "quat_to_euler",
    "quat_to_matrix",
    "quat_to_rotvec",
    "quat_to_sixd",
    "rotvec_to_quat",
    "slerp",
    "unwrap_quats",
]
