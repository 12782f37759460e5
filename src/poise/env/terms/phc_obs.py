"""Observations of Perpetual Humanoid Control (Luo et al. 2023, Sec. 3.1): next reference frame only, and
ours, which see later ones, too.

| PHC                                    | here              | numbers for B bodies, n hinges       |
|----------------------------------------|-------------------|--------------------------------------|
| s^p, proprioception                    | `self_state`      | 1 + 3 (B - 1) + 12 B (358 of 24)     |
| s^g-rot, goal with rotations           | `rotation_goal`   | 24 B (576)                           |
| s^g-kp, goal of keypoints              | `keypoint_goal`   | 9 B (216)                            |
| -, a frame of the reference later on   | `goal_later`      | 3 K + 5                              |
| -, what the filter of actions keeps    | `last_action`     | n                                    |
| -, how the goal gives way to forces    | `yielding`        | 4 + n                                |
| beta, limb lengths (and masses)        | `shape`           | 2 B - 1                              |
| what the discriminator sees of a frame | `motion_features` | 13 + 3 K + 6 J + n (196)             |

J are hinged bodies, K the tips: feet and hands.
All are seen from the character's root: offsets from it, in its heading frame.
"""

from __future__ import annotations

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.frame import Frame, ObsTerm, Pose
from poise.spatial import into_heading, quat_between, quat_conj, quat_mul, quat_to_sixd

#: The dial that a policy sees of a commanded stiffness, which is no level of compliance.
YIELDS = 0.1


def self_state(frame: Frame) -> Tensor:
    """Root height m, body places m, velocities m/s, angular velocities rad/s, rotations 6D.

    `(N, 1 + 3 (B - 1) + 3 B + 3 B + 6 B)`; the root's place is left out, since it is the origin.
    """
    sim = frame.sim
    places = sim.pos[:, 1:] - sim.pos[:, :1]
    vectors = torch.cat((places, sim.linvel, sim.angvel, _columns(sim.quat)), 1)
    return torch.cat((sim.pos[:, 0, 2:], into_heading(sim.heading, vectors).flatten(1)), -1)


def rotation_goal(frame: Frame, bodies: Tensor | None = None) -> Tensor:
    """s^g-rot = (th^ - th, p^ - p, v^ - v, w^ - w, th^, p^) of every body `(N, 24 K)`.

    ^ is the reference one step later. In order: p^ - p m (3 K), v^ - v m/s, w^ - w rad/s, p^ m from the
    root, th^ 6D (6 K) and the rotation th^ th^-1 6D, all in the heading frame (the paper writes w^ of
    the present frame, its code takes the next one, as here).

    bodies: `(K,)` rows, all by default.
    """
    sim, goal = frame.sim, _ahead(frame)
    pos, linvel, angvel, quat = (
        _rows(getattr(sim, name), bodies) for name in ("pos", "linvel", "angvel", "quat")
    )
    target, aim = _rows(goal.pos, bodies), _rows(goal.quat, bodies)
    moves = _rows(goal.linvel, bodies) - linvel, _rows(goal.angvel, bodies) - angvel
    apart = quat_mul(aim, quat_conj(quat))
    vectors = target - pos, *moves, target - sim.pos[:, :1], _columns(aim)
    # A rotation seen from elsewhere, h^-1 (w, v) h = (w, h^-1 v), turns about its turned axis.
    axis = into_heading(sim.heading, apart[..., 1:])
    turn = quat_to_sixd(torch.cat((apart[..., :1], axis), -1))
    return torch.cat((into_heading(sim.heading, torch.cat(vectors, 1)).flatten(1), turn.flatten(1)), -1)


def keypoint_goal(frame: Frame, bodies: Tensor | None = None) -> Tensor:
    """s^g-kp = (p^ - p, v^ - v, p^) of every body `(N, 9 K)`, m, m/s, m from the root; no rotations.

    ^ is the reference one step later, in the character's heading frame. bodies: as `rotation_goal`.
    """
    sim, goal = frame.sim, _ahead(frame)
    target, moves = _rows(goal.pos, bodies), _rows(goal.linvel, bodies) - _rows(sim.linvel, bodies)
    places = torch.cat((target - _rows(sim.pos, bodies), moves, target - sim.pos[:, :1]), 1)
    return into_heading(sim.heading, places).flatten(1)


def velocity_columns(bodies: int, shape: bool, rotations: bool) -> tuple[int, int]:
    """First column of v^ - v and, with rotations, w^ - w, and the first after them, where a policy
    observes `self_state`, `shape` or not, and then `rotation_goal` or `keypoint_goal` of all bodies."""
    first = 15 * bodies - 2 + (2 * bodies - 1 if shape else 0) + 3 * bodies
    return first, first + (6 if rotations else 3) * bodies


def goal_later(frame: Frame, step: int, bodies: Tensor, turns: bool = True) -> Tensor:
    """Where the reference is at one step of the task's window, in the character's heading frame.

    Its root from the character's, m (3), its bodies from its root, m (3 K), and with `turns` cosine and
    sine of its heading from the character's (2). All is 0 where the goal is a point.

    step: index into `TaskConfig.window`. bodies: `(K,)` rows.
    """
    sim, later = frame.sim, frame.window
    pos, root = later.pos[:, step], later.pos[:, step, :1]
    places = torch.cat((root - sim.pos[:, :1], _rows(pos, bodies) - root), 1)
    out = into_heading(sim.heading, places).flatten(1)
    if turns:
        w, _, _, z = quat_between(sim.heading, later.heading[:, step]).unbind(-1)
        # Of the turn's double angle, whichever sign the quaternion has.
        out = torch.cat((out, torch.stack((w * w - z * z, 2 * w * z), -1)), -1)
    return out if frame.point is None else torch.where(frame.point.far.unsqueeze(-1), 0.0, out)


def yielding(frame: Frame) -> Tensor:
    """How the goal gives way `(N, 1 + 3 + n)`: the dial, the root's displacement in the character's
    heading frame, m, and those of the hinges, rad; all 0 where nothing gives way (u of Eq. 8 of Deep
    Compliant Control). A commanded stiffness shows as the dial `YIELDS`.
    """
    u, level = frame.source("compliance/u").float(), frame.source("compliance/level").float()
    root = into_heading(frame.sim.heading, u[:, None, :3]).flatten(1)
    level = torch.where(level > 1.0, YIELDS, level)
    return torch.cat((level.unsqueeze(1), root, u[:, 6:]), 1)


def last_action(frame: Frame) -> Tensor:
    """The hinges' part of the last action, as it acted `(N, n)`; 0 in a new episode."""
    return frame.action


def shape(frame: Frame, sizes: Tensor) -> Tensor:
    """Sizes of each character's body `(N, K)`; see `shape_of`.

    sizes: `(K,)` of all of them, where the reference has one body.
    """
    return sizes.expand(frame.phase.shape[0], -1) if frame.sizes is None else frame.sizes


def shape_of(humanoid: Humanoid) -> Tensor:
    """Limb lengths, m, of all bodies but the root, then masses of all in tenths of kg: `(2 B - 1,)`."""
    rows = humanoid.table.rows
    lengths = torch.tensor([r.pos for r in rows if r.parent >= 0]).norm(dim=-1)
    return torch.cat((lengths, torch.tensor([0.1 * r.mass for r in rows]))).float()


def motion_features(frame: Frame, tips: Tensor) -> Tensor:
    """What a motion prior sees of a frame (AMP, as in PHC's code), of `frame.sim` alone.

    Root height m (1), rotation without heading 6D (6), velocity m/s and angular velocity rad/s in the
    heading frame (3 + 3), places of the bodies `tips (K,)` from the root in the heading frame m (3 K),
    turns of the hinged bodies 6D (6 J), hinge speeds rad/s (n).
    """
    sim = frame.sim
    ends = sim.pos.index_select(1, tips) - sim.pos[:, :1]
    vectors = torch.cat((sim.linvel[:, :1], sim.angvel[:, :1], ends), 1)
    moves = into_heading(sim.heading, vectors).flatten(1)
    tilt = quat_to_sixd(quat_between(sim.heading, sim.quat[:, 0]))
    turns = quat_to_sixd(sim.local).flatten(1)
    return torch.cat((sim.pos[:, 0, 2:], tilt, moves, turns, sim.qvel[:, 6:]), -1)


def style_terms(humanoid: Humanoid) -> tuple[ObsTerm, ...]:
    """PHC's features for `TaskConfig.style`; the key bodies are feet and hands."""
    tips = torch.tensor((*humanoid.feet, *humanoid.rows_of("hand")))
    return (ObsTerm("motion_features", motion_features, {"tips": tips}),)


def _rows(values: Tensor, bodies: Tensor | None) -> Tensor:
    return values if bodies is None else values.index_select(1, bodies)


def _columns(quat: Tensor) -> Tensor:
    """The 6D of rotations `(N, K, 4)` as vectors, `(N, 2 K, 3)`."""
    return quat_to_sixd(quat).unflatten(-1, (2, 3)).flatten(1, 2)


def _ahead(frame: Frame) -> Pose:
    if frame.ahead is None:
        raise ValueError("a goal needs the next reference frame")
    return frame.ahead
