"""State, features and rewards of Deep Compliant Control's imitation controller (Secs. 4.1 and 4.2).

Terms ask for `frame.shifted`, of `shifted.Shifted`; in frames of clips, which know of no displacement,
it is None and the clip's own pose is taken.
"""

from __future__ import annotations

import torch
from torch import Tensor

from poise.env.frame import Frame
from poise.env.terms.reward import pose
from poise.spatial import into_heading, quat_between, quat_to_sixd


def two_poses(frame: Frame) -> Tensor:
    """All bodies now and one control step earlier, m, from the root's place on the floor in the present
    heading frame `(N, 6 B)`, without what displaces the character."""
    own = frame.shifted
    origin = own.pos[:, :1] * own.pos.new_tensor((1.0, 1.0, 0.0))
    return into_heading(own.heading, torch.cat((own.pos, own.before), 1) - origin).flatten(1)


def turns(frame: Frame) -> Tensor:
    """The orientation of every body in the heading frame, two columns of its matrix each `(N, 6 B)`."""
    own = frame.shifted
    local = quat_between(own.heading.unsqueeze(1).expand_as(own.quat), own.quat)
    return quat_to_sixd(local).flatten(1)


def displacement(frame: Frame, source: str = "compliance/u") -> Tensor:
    """u `(N, 6 + n)`, by how much the goal is displaced, m and rad. source: "shifted/u" is known where
    nothing gives way, too."""
    return frame.source(source).float()


def posture(frame: Frame) -> Tensor:
    """What the discriminator, which is shown pairs, sees of a frame: all bodies from the root's place on
    the floor in the heading frame, m, the turns of the hinged bodies 6D, and the root's velocity, m/s,
    and speed of turning, rad/s, in that frame `(N, 3 B + 6 J + 6)`.

    Poses are without what displaces the character. The root's velocity stands for the earlier pose of
    Sec. 4.2, which a frame of a clip does not tell; it is the character's own.
    """
    own, sim = frame.shifted or frame.sim, frame.sim
    origin = own.pos[:, :1] * own.pos.new_tensor((1.0, 1.0, 0.0))
    places = into_heading(own.heading, own.pos - origin).flatten(1)
    moves = torch.stack((sim.linvel[:, 0], sim.angvel[:, 0]), 1)
    moves = into_heading(sim.heading, moves).flatten(1)
    return torch.cat((places, quat_to_sixd(own.local).flatten(1), moves), 1)


def root_place(
    frame: Frame,
    weights: tuple[float, float] = (0.7, 0.3),
    alphas: tuple[float, float] = (0.5, 1.0),
) -> Tensor:
    """r_p of Eq. 14: w_p exp(-s_p |p - u_p|^2) + w_v exp(-s_v |v - u_p'|^2), of the root against the
    displaced reference's, m and m/s in the world."""
    apart = (frame.sim.pos[:, 0] - frame.ref.pos[:, 0]).square().sum(-1)
    faster = (frame.sim.qvel[:, :3] - frame.ref.qvel[:, :3]).square().sum(-1)
    (w_p, w_v), (s_p, s_v) = weights, alphas
    return w_p * torch.exp(-s_p * apart) + w_v * torch.exp(-s_v * faster)


def posed_place(frame: Frame, alpha: float = 2.0) -> Tensor:
    """r_q r_p with a measured r_q in place of the discriminator's: `reward.pose`, which follows the
    displaced reference joint by joint."""
    return pose(frame, alpha) * root_place(frame)
