"""Observations, free of world x, y and of heading, so that a policy works anywhere.

Those of Perpetual Humanoid Control (Luo et al. 2023, Sec. 3.1), for B bodies and n hinges, see the next
reference frame alone; ours see later ones, too:

| PHC                                    | here              | numbers                          |
|----------------------------------------|-------------------|----------------------------------|
| s^p, proprioception                    | `self_state`      | 1 + 3 (B - 1) + 12 B (358 of 24) |
| s^g-rot, goal with rotations           | `rotation_goal`   | 24 B (576)                       |
| s^g-kp, goal of keypoints              | `keypoint_goal`   | 9 B (216)                        |
| -, a frame of the reference later on   | `goal_later`      | 3 K + 5                          |
| -, what the filter of actions keeps    | `last_action`     | n                                |
| -, how the goal gives way to forces    | `yielding`        | 4 + n                            |
| beta, limb lengths (and masses)        | `shape`           | 2 B - 1                          |
| what the discriminator sees of a frame | `motion_features` | 13 + 3 K + 6 J + n (196)         |

J are hinged bodies, K the tips: feet and hands. All are seen from the character's root: offsets from
it, in its heading frame.

Skeleton2Humanoid's policy (section 3.4.1) sees the state and what the next reference frames k differ
from it by:

    f_t = (q_t, v_t, j_t, g_t; q~_k - q_t, j~_k - j_t, g~_k - g_t, v~_k - v_t for each next frame k)

q are joint angles (`next_angles`), v velocities (`next_velocities`), j joint positions seen from the
head, g joint positions in the world (`next_joints`). Here the root's heading takes the place of the
world, the root's turn is 6D in place of Euler angles, and velocities are exact in place of finite
differences.
"""

from __future__ import annotations

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.frame import Frame, ObsTerm, Pose
from poise.motion.rotations import (
    into_heading,
    quat_between,
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_to_sixd,
)


def root_height(frame: Frame) -> Tensor:
    """Root height above the floor, m `(N, 1)`."""
    return frame.sim.qpos[:, 2:3]


def root_tilt(frame: Frame) -> Tensor:
    """Root orientation without heading, first two matrix columns `(N, 6)`."""
    columns = quat_to_sixd(_root(frame.sim)).unflatten(-1, (2, 3))
    return into_heading(frame.sim.heading, columns).flatten(1)


def root_velocity(frame: Frame) -> Tensor:
    """Root linear velocity in the heading frame (m/s) and angular in the root frame (rad/s) `(N, 6)`."""
    linear = into_heading(frame.sim.heading, frame.sim.qvel[:, None, :3])
    return torch.cat((linear.squeeze(1), frame.sim.qvel[:, 3:6]), -1)


def joint_angles(frame: Frame) -> Tensor:
    """Hinge angles, rad `(N, n)`."""
    return frame.sim.qpos[:, 7:]


def joint_velocities(frame: Frame) -> Tensor:
    """Hinge speeds, rad/s `(N, n)`."""
    return frame.sim.qvel[:, 6:]


def phase(frame: Frame) -> Tensor:
    """Place in the clip from 0 to 1 `(N, 1)`."""
    return frame.phase.unsqueeze(-1)


def body_positions(frame: Frame) -> Tensor:
    """Body origins relative to the root in the heading frame, m `(N, 3 (B - 1))`."""
    sim = frame.sim
    return into_heading(sim.heading, sim.pos[:, 1:] - sim.pos[:, :1]).flatten(1)


def target_joints(frame: Frame) -> Tensor:
    """Next reference hinge angles minus the present ones, rad, and their speeds `(N, 2 n)`."""
    ahead = _ahead(frame)
    return torch.cat((ahead.qpos[:, 7:] - frame.sim.qpos[:, 7:], ahead.qvel[:, 6:]), -1)


def target_root(frame: Frame) -> Tensor:
    """Next reference root against the present one, in the present heading frame `(N, 12)`.

    Position difference m, orientation difference 6D, reference velocity m/s.
    """
    ahead, sim = _ahead(frame), frame.sim
    vectors = torch.stack((ahead.pos[:, 0] - sim.pos[:, 0], ahead.qvel[:, :3]), 1)
    offset, velocity = into_heading(sim.heading, vectors).unbind(1)
    turn = quat_between(_root(sim), _root(ahead))
    return torch.cat((offset, quat_to_sixd(turn), velocity), -1)


def target_bodies(frame: Frame) -> Tensor:
    """Next reference body origins minus the present ones, in the present heading frame, m."""
    return into_heading(frame.sim.heading, _ahead(frame).pos - frame.sim.pos).flatten(1)


def _root(pose: Pose) -> Tensor:
    return pose.qpos[:, 3:7]


def _ahead(frame: Frame) -> Pose:
    if frame.ahead is None:
        raise ValueError("observations of the reference need the next reference frame")
    return frame.ahead


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


#: The columns of `rotation_goal` and of `keypoint_goal`, of each body.
ROTATION_PARTS = {"pos": 3, "linvel": 3, "angvel": 3, "place": 3, "rot": 6, "turn": 6}
KEYPOINT_PARTS = {"pos": 3, "linvel": 3, "place": 3}


def rotation_goal(frame: Frame, bodies: Tensor | None = None) -> Tensor:
    """s^g-rot = (th^ - th, p^ - p, v^ - v, w^ - w, th^, p^) of every body `(N, 24 K)`.

    ^ is the reference one step later. In order: p^ - p m (3 K), v^ - v m/s, w^ - w rad/s, p^ m from the
    root, th^ 6D (6 K) and the rotation th^ th^-1 6D, all in the heading frame (the paper writes w^ of
    the present frame, its code takes the next one, as here).

    bodies: `(K,)` rows, all by default.
    """
    sim, goal = frame.sim, _ahead_phc_obs(frame)
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
    sim, goal = frame.sim, _ahead_phc_obs(frame)
    target, moves = _rows(goal.pos, bodies), _rows(goal.linvel, bodies) - _rows(sim.linvel, bodies)
    places = torch.cat((target - _rows(sim.pos, bodies), moves, target - sim.pos[:, :1]), 1)
    return into_heading(sim.heading, places).flatten(1)


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


def _ahead_phc_obs(frame: Frame) -> Pose:
    if frame.ahead is None:
        raise ValueError("a goal needs the next reference frame")
    return frame.ahead


def joints_from_head(frame: Frame, head: int) -> Tensor:
    """j: body origins in the head's own frame, m `(N, 3 B)`. head: its row."""
    return _from_head(frame.sim, head).flatten(1)


def next_angles(frame: Frame, step: int) -> Tensor:
    """q~ - q: the root's turn to a later reference frame, 6D, and the hinge angles that are missing, rad
    `(N, 6 + n)`. step: index into `TaskConfig.window`."""
    sim, later = frame.sim, frame.window
    turn = quat_between(sim.qpos[:, 3:7], later.qpos[:, step, 3:7])
    return torch.cat((quat_to_sixd(turn), later.qpos[:, step, 7:] - sim.qpos[:, 7:]), -1)


def next_velocities(frame: Frame, step: int) -> Tensor:
    """v~ - v: of the root in the heading frame, m/s, and in its own, rad/s, and of the hinges, rad/s
    `(N, 6 + n)`."""
    sim, later = frame.sim, frame.window
    missing = later.qvel[:, step] - sim.qvel
    linear = into_heading(sim.heading, missing[:, None, :3]).squeeze(1)
    return torch.cat((linear, missing[:, 3:]), -1)


def next_joints(frame: Frame, step: int, head: int) -> Tensor:
    """j~ - j and g~ - g, m `(N, 6 B)`: seen from each one's own head, and in the heading frame."""
    sim, later = frame.sim, frame.window
    own = _from_head(sim, head)
    pos = later.pos[:, step]
    turned = quat_conj(later.quat[:, step, head]).unsqueeze(1)
    seen = quat_rotate(turned, pos - pos[:, head : head + 1])
    world = into_heading(sim.heading, pos - sim.pos)
    return torch.cat((seen - own, world), 1).flatten(1)


def _from_head(pose: Pose, head: int) -> Tensor:
    away = pose.pos - pose.pos[:, head : head + 1]
    return quat_rotate(quat_conj(pose.quat[:, head]).unsqueeze(1), away)
