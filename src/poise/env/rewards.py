"""Rewards of Residual Force Control and of Perpetual Humanoid Control; failures that end an episode.

Eqs. 8 to 14 are those of Residual Force Control, appendix B (the forms of DeepMimic and EgoPose). Every
one of these rewards is `(N,)` in (0, 1], and is 1 exactly at the reference. The functions from
`body_positions` on are of Perpetual Humanoid Control (Luo et al. 2023): imitation, Eq. 2
(`imitation_terms`), the energy penalty of Eq. 1 (`energy_term`), and recovery, Eq. 4 (`recovery_terms`).
The root's place by itself and the prices of rough motion are ours.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.frame import Frame, Pose, RewardTerm, TermFunction
from poise.metrics.plausibility import CONTACT_HEIGHT, CONTACT_RISE, SWING_SPEED
from poise.motion.rotations import into_heading, quat_between, quat_distance, quat_rotate


def pose(frame: Frame, alpha: float = 2.0, weights: Tensor | None = None, half: bool = False) -> Tensor:
    """Eq. 8: exp(-alpha sum_j |b_j (-) b^_j|^2), |.| the rotation angle in rad.

    weights: `(J,)` per joint. half: the authors' code takes arccos|w|, half the angle.
    """
    angle = quat_distance(frame.sim.local, frame.ref.local)
    squared = (0.5 * angle if half else angle).square()
    return torch.exp(-alpha * (squared if weights is None else squared * weights).sum(-1))


def velocity(frame: Frame, alpha: float = 0.005, weights: Tensor | None = None) -> Tensor:
    """Eq. 9: exp(-alpha |q' - q^'|^2) over the hinges, rad/s. weights: `(n,)` per hinge."""
    error = frame.sim.qvel[:, 6:] - frame.ref.qvel[:, 6:]
    squared = error.square()
    return torch.exp(-alpha * (squared if weights is None else squared * weights).sum(-1))


def end_effectors(frame: Frame, bodies: Tensor, alpha: float = 5.0, local: bool = False) -> Tensor:
    """Eq. 10: exp(-alpha sum_e |g_e - g^_e|^2), m, world; `local`: in each one's own heading frame."""
    ours, theirs = (p.pos.index_select(1, bodies) for p in (frame.sim, frame.ref))
    if local:
        ours, theirs = _in_heading(frame.sim, ours), _in_heading(frame.ref, theirs)
    return torch.exp(-alpha * (ours - theirs).square().sum((-1, -2)))


def centre_of_mass(frame: Frame, alpha: float = 100.0) -> Tensor:
    """Eq. 11: exp(-alpha |c - c^|^2), m, world."""
    return torch.exp(-alpha * (frame.sim.com - frame.ref.com).square().sum(-1))


def root_pose(frame: Frame, alpha: float = 300.0, half: bool = False) -> Tensor:
    """Eq. 13: exp(-alpha ((y - y^)^2 + |o (-) o^|^2)), root height m and orientation rad.

    The orientations are compared with their headings removed, since all features are local.
    """
    height = frame.sim.pos[:, 0, 2] - frame.ref.pos[:, 0, 2]
    ours = quat_between(frame.sim.heading, frame.sim.quat[:, 0])
    theirs = quat_between(frame.ref.heading, frame.ref.quat[:, 0])
    angle = quat_distance(ours, theirs)
    angle = 0.5 * angle if half else angle
    return torch.exp(-alpha * (height.square() + angle.square()))


def root_velocity(frame: Frame, alpha: float = 0.1) -> Tensor:
    """Eq. 14: exp(-|l - l^|^2 - alpha |w - w^|^2), m/s and rad/s, each in its own heading frame."""
    ours, theirs = (
        into_heading(p.heading, torch.stack((p.qvel[:, :3], p.angvel[:, 0]), 1))
        for p in (frame.sim, frame.ref)
    )
    linear, angular = (ours - theirs).unbind(1)
    return torch.exp(-linear.square().sum(-1) - alpha * angular.square().sum(-1))


def residual(frame: Frame) -> Tensor:
    """Eqs. 3 and 5: the regularizer of the residual force, 1 without help."""
    return frame.reg


def _in_heading(pose_: Pose, points: Tensor) -> Tensor:
    """World points `(N, K, 3)` relative to the root in the character's heading frame."""
    return into_heading(pose_.heading, points - pose_.pos[:, :1])


Form = Literal["paper", "code"]


def body_positions(frame: Frame, alpha: float = 100.0, form: Form = "code") -> Tensor:
    """First term of Eq. 2: places of all bodies, m, world. `(N,)` in (0, 1]."""
    return _vectors(frame.sim.pos - frame.ref.pos, alpha, form)


def body_rotations(frame: Frame, alpha: float = 10.0, form: Form = "code") -> Tensor:
    """Second term of Eq. 2: rotations of all bodies, rad, world. `(N,)` in (0, 1]."""
    angle = quat_distance(frame.sim.quat, frame.ref.quat)
    return torch.exp(-alpha * (angle if form == "paper" else angle.square()).mean(-1))


def body_velocities(frame: Frame, alpha: float = 0.1, form: Form = "code") -> Tensor:
    """Third term of Eq. 2: velocities of all bodies, m/s, world. `(N,)` in (0, 1]."""
    return _vectors(frame.sim.linvel - frame.ref.linvel, alpha, form)


def body_angular_velocities(frame: Frame, alpha: float = 0.1, form: Form = "code") -> Tensor:
    """Last term of Eq. 2: angular velocities of all bodies, rad/s, world. `(N,)` in (0, 1]."""
    return _vectors(frame.sim.angvel - frame.ref.angvel, alpha, form)


def root_position(frame: Frame, alpha: float = 10.0) -> Tensor:
    """e^(-alpha |p^ - p|) of the root's place alone, m, world: 0.37 at 0.1 m. `(N,)` in (0, 1].

    With "code" Eq. 2 tells a whole body that is 5 cm off from one in place by 4 % of its first term, and
    nothing more from 0.4 m on; this one drops steadily from the first centimetre.
    """
    return torch.exp(-alpha * (frame.sim.pos[:, 0] - frame.ref.pos[:, 0]).norm(dim=-1))


def action_rate(frame: Frame) -> Tensor:
    """A cost: squared change of the hinges' actions from step to step, mean over the hinges. `(N,)`

    In rad^2 for additive actions: 0.003 under noise of 0.04 rad. An episode's first action costs
    nothing.
    """
    change = (frame.action - frame.action_before).square().mean(-1)
    return _after_first(frame, change)


def torque_rate(frame: Frame, limits: Tensor) -> Tensor:
    """A cost: squared change of the hinges' torques from step to step in units of their limits, mean
    over the hinges. `(N,)`

    limits: `(n,)` N m. An episode's first step costs nothing.
    """
    if frame.torque is None or frame.torque_before is None:
        raise ValueError("the rate of torques needs the hinges' torques now and before")
    change = ((frame.torque - frame.torque_before) / limits).square().mean(-1)
    return _after_first(frame, change)


def acceleration(frame: Frame) -> Tensor:
    """A cost: m/s by which the bodies' velocities change otherwise than the reference's in a control
    step, length of each body's, mean over the bodies. `(N,)`

    At 30 Hz 0.3 of it is an E_acc of PHC of 10 mm/frame^2.
    """
    change = frame.sim.linvel - frame.ref.linvel - frame.linvel_before
    return change.norm(dim=-1).mean(-1)


def foot_slide(frame: Frame, rows: Tensor, points: Tensor) -> Tensor:
    """A cost: m/s with which points of the soles that touch the ground move along it, summed over the
    points and divided by half their number, so that a foot that skates counts as fast as it is. `(N,)`

    What touches is what `metrics.foot_contacts` says.

    rows: `(P,)` body of each point. points: `(P, 3)` m in its frame.
    """
    sim = frame.sim
    pos, quat, linvel, angvel = (
        getattr(sim, name).index_select(1, rows) for name in ("pos", "quat", "linvel", "angvel")
    )
    arm = quat_rotate(quat, points.expand_as(pos))
    # v(p) = v(o) + omega x (p - o)
    moves = linvel + torch.linalg.cross(angvel, arm)
    low, speed = (pos + arm)[..., 2] <= CONTACT_HEIGHT, moves[..., :2].norm(dim=-1)
    contact = low & (moves[..., 2].abs() <= CONTACT_RISE)
    planted = contact & (speed <= SWING_SPEED)
    contact = torch.where(planted.any(-1, keepdim=True), planted, contact)
    return (speed * contact).sum(-1) / (points.shape[0] / 2)


def cost_term(fn: TermFunction, weight: float, task_weight: float = 1.0, **params: Any) -> RewardTerm:
    """A cost with its price per unit; task_weight: as in `energy_term`."""
    return RewardTerm(fn.__name__, fn, -weight / task_weight, params, imitation=False)


def _after_first(frame: Frame, cost: Tensor) -> Tensor:
    if frame.age is None:
        raise ValueError("what changes from step to step needs the age of the episodes")
    return torch.where(frame.age > 1, cost, 0.0)


def energy(frame: Frame, form: Form = "code", exempt: int = 3) -> Tensor:
    """A cost: sum over the hinges of |torque * speed|, W ("code"), or of its square ("paper"). `(N,)`.

    The torque is that of the servos in the step's last physics step, less the damping at its end.

    exempt: control steps at the begin of an episode that cost nothing, 3 in the code, since a start on
    the reference begins with a jerk.
    """
    if frame.torque is None or frame.age is None:
        raise ValueError("the energy needs the hinges' torques and the age of the episodes")
    power = (frame.torque * frame.sim.qvel[:, 6:]).abs()
    total = (power.square() if form == "paper" else power).sum(-1)
    return torch.where(frame.age > exempt, total, 0.0)


def imitation_terms(form: Form = "code") -> tuple[RewardTerm, ...]:
    """Eq. 2 as terms of a task.

        r = 0.5 e^(-100 |p^ - p|) + 0.3 e^(-10 |q^ - q|) + 0.1 e^(-0.1 |v^ - v|) + 0.1 e^(-0.1 |w^ - w|)

    over the places, rotations, velocities and angular velocities of all bodies; the reference is that of
    the frame reached. Paper and code differ in what |.| is, which `form` decides:

    | form  | what is taken of the error                                                          |
    |-------|-------------------------------------------------------------------------------------|
    | paper | a norm: the length of each body's error (angle for rotations), mean over the bodies |
    | code  | the mean over bodies and axes of the squared error; squared angle, mean over bodies |

    The paper states one norm and not over what; a mean does not grow with the number of bodies. At 3 cm
    the place is worth e^-3 = 0.05 with "paper", and e^(-100 0.0003) = 0.97 with "code". Weights are from
    the code; the paper names none.
    """
    given = {"form": form}
    return (
        RewardTerm("body_positions", body_positions, 0.5, given),
        RewardTerm("body_rotations", body_rotations, 0.3, given),
        RewardTerm("body_velocities", body_velocities, 0.1, given),
        RewardTerm("body_angular_velocities", body_angular_velocities, 0.1, given),
    )


def energy_term(
    task_weight: float = 0.5, form: Form = "code", weight: float = 0.0005, exempt: int = 3
) -> RewardTerm:
    """The energy penalty of Eq. 1, r = w_task r_task + w_style r_style - 0.0005 energy.

    Args:
        task_weight: w_task, with which a motion prior multiplies the whole task reward and by which the
            weight is divided here, since the penalty is not halved (1 without a prior).
        weight: 0.0005 for primitives; the code's composer has 0.00005, and Eq. 4 a tenth, 0.00005, for
            recovery.

    An expert that walks a body of 64 kg on the reference spends 530 W, and 1,700 W under a noise of
    0.055 rad on its targets: at 0.0005 it loses 0.26 and 0.84 of the reward of at most about 1. Where
    nothing is left above 0, falling early pays; then take the composer's weight, or less noise. The
    paper's squares are 49,000 W^2 there, so that its formula with its weight leaves nothing at all.
    """
    return cost_term(energy, weight, task_weight, form=form, exempt=exempt)


def _vectors(error: Tensor, alpha: float, form: Form) -> Tensor:
    """e^(-alpha |error|) of errors `(N, B, 3)`."""
    size = error.norm(dim=-1).mean(-1) if form == "paper" else error.square().mean((-1, -2))
    return torch.exp(-alpha * size)


#: Of the energy penalty, what Eq. 4 counts.
TENTH = 0.1


def point_goal(frame: Frame, gain: float = 1.0, most: float = float("inf")) -> Tensor:
    """gain min(d_(t-1) - d_t, most), `(N,)`: m that the character came nearer to the reference's root
    in a step; below 0 where it went away.

    The reference moves, too; one that runs away at the character's speed leaves nothing to earn.
    """
    if frame.point is None:
        raise ValueError("a point goal needs a task with recovery")
    return gain * (frame.point.before - frame.point.distance).clamp_max(most)


def point_goal_term(form: Form = "paper") -> RewardTerm:
    """r_point as a term of a task: far from the reference ("paper"), or everywhere ("code")."""
    if form == "paper":
        return RewardTerm("point_goal", point_goal, 1.0, imitation=False, when="far")
    return RewardTerm("point_goal", point_goal, 1.0, {"gain": 9.0, "most": 1 / 3}, imitation=False)


def recovery_terms(rewards: tuple[RewardTerm, ...], form: Form = "paper") -> tuple[RewardTerm, ...]:
    """The rewards of a task without recovery, and the point goal, each where it counts (Eq. 4):

        r = 0.5 r_point + 0.5 r_amp + 0.1 r_energy,    r_point = d_(t-1) - d_t

    with d_t m between the roots of the character and of its reference. A motion prior gives 0.5 r_amp
    and halves the rest.

    | form  | near the reference                    | far from it                         |
    |-------|---------------------------------------|-------------------------------------|
    | paper | Eq. 2 and the energy                  | r_point and a tenth of the energy   |
    | code  | half of Eq. 2, r_point and the energy | r_point and the energy              |

    The code's r_point is 9 min(d_(t-1) - d_t, 1/3): 0.3 for walking at 1 m/s at 30 Hz, where the paper's
    is 0.033.

    rewards: terms of imitation; costs, such as the energy; others count everywhere as before.
    """
    out = []
    for term in rewards:
        if term.imitation:
            share = 1.0 if form == "paper" else 0.5
            out.append(replace(term, weight=share * term.weight, when="near"))
        elif term.weight < 0 and form == "paper":
            away = replace(term, name=f"{term.name}_far", weight=TENTH * term.weight, when="far")
            out += replace(term, when="near"), away
        else:
            out.append(term)
    return (*out, point_goal_term(form))


def root_too_low(frame: Frame, margin: float = 0.1) -> Tensor:
    """The root is more than `margin` m below the clip's lowest reference height (the paper's rule)."""
    return frame.sim.pos[:, 0, 2] < frame.min_height - margin


def root_below(frame: Frame, margin: float = 0.5) -> Tensor:
    """The root is more than `margin` m lower than the reference's now (Skeleton2Humanoid)."""
    return frame.sim.pos[:, 0, 2] < frame.ref.pos[:, 0, 2] - margin


def bodies_too_far(
    frame: Frame, limit: float = 0.5, bodies: Tensor | None = None, grace: int = 0
) -> Tensor:
    """The bodies are on average more than `limit` m away from the reference (UHC, PHC).

    Args:
        bodies: `(K,)` rows that count, all by default; `all_but_feet` is PHC's relaxed early
            termination.
        grace: control steps at the begin of an episode in which no character fails.
    """
    return _from(grace, frame, _distance(frame, bodies).mean(-1) > limit)


def any_body_too_far(
    frame: Frame, limit: float = 0.25, bodies: Tensor | None = None, grace: int = 0
) -> Tensor:
    """Some body is more than `limit` m away from the reference (PHC's code in training, grace 1).

    The rest as in `bodies_too_far`.
    """
    return _from(grace, frame, _distance(frame, bodies).amax(-1) > limit)


def all_but_feet(humanoid: Humanoid) -> Tensor:
    """`(K,)` rows without feet (ankles and toes), which may leave the reference to keep the balance."""
    return torch.tensor([i for i, r in enumerate(humanoid.table.rows) if r.kind != "foot"])


def _distance(frame: Frame, bodies: Tensor | None) -> Tensor:
    """Of each body from its reference, m `(N, K)`."""
    apart = frame.sim.pos - frame.ref.pos
    return (apart if bodies is None else apart.index_select(1, bodies)).norm(dim=-1)


def _from(grace: int, frame: Frame, failed: Tensor) -> Tensor:
    """`failed (N,)` of episodes that are older than `grace` control steps."""
    if not grace:
        return failed
    if frame.age is None:
        raise ValueError("a grace at the begin of an episode needs the age of the episodes")
    return failed & (frame.age > grace)
