"""The observables that every environment has: what terms see, each one function of the `Frame`.

A new observable is one more function here, and every term can ask for it by its name:

    def contact_torque(frame: Frame) -> Tensor:
        \"""`(N, n)` N m that contacts and limits exert on each hinge.\"""
        return frame.source("qfrc_constraint")[:, 6:].float()

A field of MuJoCo's state that a `source` names is fetched for tasks that ask for it alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import FunctionType

import torch
from torch import Tensor

from poise.control import Residual
from poise.env.frame import Frame, Layout, LazyPose, Observable, Place, PointGoal, Pose
from poise.spatial import heading_quat, lateral_heading


@dataclass(frozen=True, eq=False)
class Context:
    """What all frames of one environment share.

    layout: where the numbers of packed poses stand.
    local: the turns of the hinged bodies `(N, J, 4)` of coordinates `(N, 7 + n)`.
    roots: `(B,)` each body's root, as a body of the model.
    hinges: how many there are; the rest of an action is the residual's.
    residual: the kind of residual force, None without.
    left: `(3,)` the root's axis by which headings are taken, see `TaskConfig.left`; None: its twist.
    """

    layout: Layout
    local: Callable[[Tensor], Tensor]
    roots: Tensor
    hinges: int
    residual: Residual | None
    left: Tensor | None


def headed(pose: Pose, left: Tensor | None) -> Pose:
    """Poses as an environment sees them, with headings by the root's axis `left (3)`; packed ones hold
    the twist."""
    return pose if left is None else replace(pose, heading=lateral_heading(pose.qpos[..., 3:7], left))


def hinge_torques(servos: Tensor, damping: Tensor) -> Tensor:
    """What both of MuJoCo's generalized forces `(N, 6 + n)` exert on each hinge, N m `(N, n)`."""
    return (servos + damping)[:, 6:].float()


def sim(frame: Frame) -> Pose:
    """The simulated characters; read it before the next step."""

    def linvel() -> Tensor:
        # v(xpos) = v(c) + omega x (xpos - c), see `sim.body_linear_velocity_w`.
        arm = pose.pos - frame.source("subtree_com").index_select(1, frame.context.roots).float()
        return frame.source("cvel")[:, 1:, 3:].float() + torch.linalg.cross(pose.angvel, arm)

    def heading() -> Tensor:
        root, left = pose.qpos[:, 3:7], frame.context.left
        return heading_quat(root) if left is None else lateral_heading(root, left)

    pose = LazyPose(
        qpos=lambda: frame.source("qpos").float(),
        qvel=lambda: frame.source("qvel").float(),
        pos=lambda: frame.source("xpos")[:, 1:].float(),
        quat=lambda: frame.source("xquat")[:, 1:].float(),
        linvel=linvel,
        angvel=lambda: frame.source("cvel")[:, 1:, :3].float(),
        com=lambda: frame.source("subtree_com")[:, 1].float(),
        local=lambda: frame.context.local(pose.qpos),
        heading=heading,
    )
    return pose


def ref(frame: Frame) -> Pose:
    """What the goal asks for now."""
    return headed(frame.context.layout.unpacked(frame.source("goal")), frame.context.left)


def ahead(frame: Frame) -> Pose | None:
    """What the goal asks for one control step later."""
    return headed(frame.context.layout.unpacked(frame.source("ahead")), frame.context.left)


def window(frame: Frame) -> Pose:
    """What the goal asks for at the steps of the task's window, fields `(N, K, ...)`."""
    return headed(frame.context.layout.unpacked(frame.source("window")), frame.context.left)


def place(frame: Frame) -> Place:
    """Where in its clip the goal is."""
    return frame.context.layout.place(frame.source("goal"))


def phase(frame: Frame) -> Tensor:
    """Place in the clip, 0 to 1 `(N,)`."""
    return frame.place.phase


def min_height(frame: Frame) -> Tensor:
    """The clip's lowest root height, m `(N,)`."""
    return frame.place.low


def action(frame: Frame) -> Tensor:
    """The hinges' part of the last action, as it acted `(N, n)`."""
    return frame.source("action")[:, : frame.context.hinges]


def action_before(frame: Frame) -> Tensor:
    """The same of the step before `(N, n)`."""
    return frame.source("action_before")[:, : frame.context.hinges]


def residual(frame: Frame) -> Tensor:
    """The last step's residual action, unscaled `(N, k)`."""
    return frame.source("action")[:, frame.context.hinges :]


def reg(frame: Frame) -> Tensor:
    """The regularizer of the residual `(N,)`, 1 without help."""
    kind: Residual | None = frame.context.residual
    return torch.ones_like(frame.phase) if kind is None else kind.regularizer(frame.residual)


def age(frame: Frame) -> Tensor | None:
    """Control steps since the episode began `(N,)`."""
    return frame.source("age")


def torque(frame: Frame) -> Tensor | None:
    """What servos and damping exert on each hinge at the end of the step, N m `(N, n)`."""
    return hinge_torques(frame.source("qfrc_actuator"), frame.source("qfrc_damper"))


def torque_before(frame: Frame) -> Tensor | None:
    """The same at the begin of the step `(N, n)`."""
    return frame.source("torque_before")


def linvel_before(frame: Frame) -> Tensor:
    """Velocities of the bodies less the reference's at the begin of the step, m/s `(N, B, 3)`."""
    return frame.source("linvel_before")


def point(frame: Frame) -> PointGoal | None:
    """Where the reference's root is; the recovery plug-in says it."""
    return None


def sizes(frame: Frame) -> Tensor | None:
    """Sizes of each character's body; the body assignment says them."""
    return None


#: All functions of this file by name.
STANDARD: dict[str, Observable] = {
    name: fn
    for name, fn in vars().copy().items()
    if getattr(fn, "__module__", "") == __name__
    and isinstance(fn, FunctionType)
    and name not in ("headed", "hinge_torques")
}
