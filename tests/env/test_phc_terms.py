"""PHC's observations and rewards against naive twins in NumPy and by hand, and their invariance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from poise.body import generate_table, make_humanoid
from poise.env import ObsTerm, RewardTerm
from poise.env import observations as obs
from poise.env import rewards as reward
from poise.env.frame import Frame, PointGoal, Pose
from poise.motion.rotations import axis_angle_to_quat, heading_quat, normalize, quat_mul, quat_rotate
from refusals import refused
from toy_human import human

N, B, J, H = 3, 5, 4, 6
TIPS = torch.tensor([2, 4])
OBSERVATIONS = [
    (obs.self_state, {}),
    (obs.rotation_goal, {}),
    (obs.rotation_goal, {"bodies": torch.tensor([3, 0])}),
    (obs.keypoint_goal, {}),
    (obs.keypoint_goal, {"bodies": torch.tensor([3, 0])}),
    (obs.motion_features, {"tips": TIPS}),
    (obs.goal_later, {"step": 1, "bodies": torch.tensor([3, 1])}),
]
REWARDS = [
    reward.body_positions,
    reward.body_rotations,
    reward.body_velocities,
    reward.body_angular_velocities,
]


def a_pose(seed: int, bodies: int = B, joints: int = J, hinges: int = H) -> Pose:
    rng = torch.Generator().manual_seed(seed)

    def randn(*shape: int) -> torch.Tensor:
        return torch.randn(N, *shape, generator=rng)

    quat, pos = normalize(randn(bodies, 4)), randn(bodies, 3)
    linvel, angvel, qvel = randn(bodies, 3), randn(bodies, 3), randn(6 + hinges)
    qpos = torch.cat((pos[:, 0], quat[:, 0], randn(hinges)), -1)
    local = normalize(randn(joints, 4))
    return Pose(qpos, qvel, pos, quat, linvel, angvel, randn(3), local, heading_quat(quat[:, 0]))


def a_frame(
    sim: Pose, ahead: Pose | None = None, ref: Pose | None = None, **more: torch.Tensor
) -> Frame:
    ones = torch.ones(N)
    given = {"phase": ones, "residual": torch.zeros(N, 0), "reg": ones, "min_height": ones}
    window = ahead and Pose(*(torch.stack((x, x), 1) for x in vars(ahead).values()))
    return Frame.given(sim=sim, ref=ref or sim, ahead=ahead, window=window, **(given | more))


def moved(pose: Pose, yaw: float, shift: tuple[float, float]) -> Pose:
    """The same character in a world turned about +Z and moved along the floor."""
    q = axis_angle_to_quat(torch.tensor([0.0, 0, 1]), torch.tensor(yaw))
    n, b = pose.pos.shape[:2]
    turns, move = q.expand(n, b, 4), torch.tensor([*shift, 0.0])
    quat = quat_mul(turns, pose.quat)
    return replace(
        pose,
        pos=quat_rotate(turns, pose.pos) + move,
        quat=quat,
        linvel=quat_rotate(turns, pose.linvel),
        angvel=quat_rotate(turns, pose.angvel),
        heading=heading_quat(quat[:, 0]),
    )


# --- naive twins -----------------------------------------------------------------------------------


def rotations(quat: torch.Tensor) -> list[Rotation]:
    return [Rotation.from_quat(q.double().numpy(), scalar_first=True) for q in quat]


def sixd(turn: Rotation) -> np.ndarray:
    m = turn.as_matrix()
    return np.concatenate((m[:, 0], m[:, 1]))


def facing(quat: np.ndarray) -> np.ndarray:
    """The world to heading matrix of a root wxyz: its twist about Z, taken off."""
    w, _, _, z = quat
    return Rotation.from_euler("z", 2 * math.atan2(z, w)).inv().as_matrix()


def naive(name: str, sim: Pose, goal: Pose, bodies: list[int], world: int) -> np.ndarray:
    at = {k: getattr(sim, k)[world].double().numpy() for k in ("pos", "linvel", "angvel", "qvel")}
    to = {k: getattr(goal, k)[world].double().numpy() for k in ("pos", "linvel", "angvel")}
    h = facing(sim.quat[world, 0].double().numpy())
    turn = Rotation.from_matrix(h)
    now, then, local = (rotations(x[world]) for x in (sim.quat, goal.quat, sim.local))
    root, parts = at["pos"][0], []
    if name == "self_state":
        parts = [root[2:], *(h @ (p - root) for p in at["pos"][1:])]
        parts += [h @ v for v in at["linvel"]] + [h @ v for v in at["angvel"]]
        parts += [sixd(turn * r) for r in now]
    elif name == "rotation_goal":
        parts = [h @ (to["pos"][b] - at["pos"][b]) for b in bodies]
        parts += [h @ (to["linvel"][b] - at["linvel"][b]) for b in bodies]
        parts += [h @ (to["angvel"][b] - at["angvel"][b]) for b in bodies]
        parts += [h @ (to["pos"][b] - root) for b in bodies]
        parts += [sixd(turn * then[b]) for b in bodies]
        # What turns the present into the target, a world turn seen from the heading.
        parts += [sixd(turn * (then[b] * now[b].inv()) * turn.inv()) for b in bodies]
    elif name == "keypoint_goal":
        parts = [h @ (to["pos"][b] - at["pos"][b]) for b in bodies]
        parts += [h @ (to["linvel"][b] - at["linvel"][b]) for b in bodies]
        parts += [h @ (to["pos"][b] - root) for b in bodies]
    elif name == "goal_later":
        begin = to["pos"][0]
        yaw = (Rotation.from_matrix(facing(goal.quat[world, 0].double().numpy())).inv() * turn).as_euler(
            "ZYX"
        )[0]
        parts = [h @ (begin - root), *(h @ (to["pos"][b] - begin) for b in bodies)]
        parts += [np.array([math.cos(yaw), math.sin(yaw)])]
    else:
        parts = [root[2:], sixd(turn * now[0]), h @ at["linvel"][0], h @ at["angvel"][0]]
        parts += [h @ (at["pos"][b] - root) for b in TIPS.tolist()]
        parts += [*(sixd(r) for r in local), at["qvel"][6:]]
    return np.concatenate(parts)


@pytest.mark.parametrize(("term", "params"), OBSERVATIONS)
def test_observations_are_those_of_a_naive_twin(term, params):
    sim, goal = a_pose(0), a_pose(1)
    given = term(a_frame(sim, goal), **params)
    bodies = params["bodies"].tolist() if "bodies" in params else list(range(B))
    want = np.stack([naive(term.__name__, sim, goal, bodies, i) for i in range(N)])
    np.testing.assert_allclose(given.numpy(), want, atol=3e-6)


@pytest.mark.parametrize(("term", "params"), OBSERVATIONS)
def test_observations_are_free_of_place_and_heading(term, params):
    sim, goal = a_pose(2), a_pose(3)
    here = term(a_frame(sim, goal), **params)
    there = term(a_frame(moved(sim, 2.3, (4.0, -7.0)), moved(goal, 2.3, (4.0, -7.0))), **params)
    torch.testing.assert_close(there, here, atol=2e-5, rtol=1e-4)
    # The goal is where it is in the world: moved alone, it is another goal.
    if "goal" in term.__name__:
        assert not torch.allclose(
            term(a_frame(sim, moved(goal, 0.3, (1.0, 0.0))), **params), here, atol=0.1
        )


def test_widths_on_phcs_body_are_the_papers():
    smpl = a_frame(a_pose(0, 24, 19, 57), a_pose(1, 24, 19, 57))
    assert obs.self_state(smpl).shape == (N, 358)
    assert obs.rotation_goal(smpl).shape == (N, 576)
    assert obs.keypoint_goal(smpl).shape == (N, 216)
    assert obs.motion_features(smpl, torch.tensor([3, 4, 20, 21])).shape == (N, 196)


def test_at_the_goal_the_differences_are_nothing():
    sim = a_pose(4)
    goal = obs.rotation_goal(a_frame(sim, sim))
    assert not goal[:, : 9 * B].any()
    turned = goal[:, 18 * B :].unflatten(1, (B, 6))
    identity = torch.tensor([1.0, 0, 0, 0, 1, 0]).expand(N, B, 6)
    torch.testing.assert_close(turned, identity, atol=1e-6, rtol=0)
    assert not obs.keypoint_goal(a_frame(sim, sim))[:, : 6 * B].any()


def test_a_keypoint_goal_never_looks_at_rotations():
    sim, goal = a_pose(0), a_pose(1)
    blind = replace(
        goal,
        **{k: torch.full_like(getattr(goal, k), torch.nan) for k in ("quat", "angvel", "local", "qpos")},
    )
    assert obs.keypoint_goal(a_frame(sim, blind)).isfinite().all()
    for term in (obs.rotation_goal, obs.keypoint_goal):
        with pytest.raises(ValueError, match="next reference frame"):
            term(a_frame(sim))


def test_a_later_goal_tells_keypoints_no_turn_and_a_point_nothing():
    frame = a_frame(a_pose(0), a_pose(1))
    bodies = torch.tensor([1, 2])
    whole = obs.goal_later(frame, 0, bodies)
    assert torch.equal(obs.goal_later(frame, 0, bodies, turns=False), whole[:, :-2])
    far = PointGoal(torch.tensor([True, False, False]), torch.ones(N), torch.ones(N))
    told = obs.goal_later(frame.replaced(point=far), 0, bodies)
    assert not told[0].any() and torch.equal(told[1:], whole[1:])


def test_the_shape_is_limb_lengths_and_masses():
    humanoid = make_humanoid(human(), generate_table(human()))
    sizes, rows = obs.shape_of(humanoid), humanoid.table.rows
    assert sizes.shape == (2 * len(rows) - 1,)
    shin = [r.kind for r in rows].index("shin")
    assert float(sizes[shin - 1]) == pytest.approx(0.42, abs=1e-6)
    assert 10 * float(sizes[len(rows) - 1 :].sum()) == pytest.approx(humanoid.mass, rel=1e-5)
    out = obs.shape(a_frame(a_pose(0)), sizes)
    assert out.shape == (N, len(sizes)) and torch.equal(out[2], sizes)
    assert isinstance(obs.style_terms(humanoid)[0], ObsTerm)
    tips = obs.style_terms(humanoid)[0].params["tips"].tolist()
    assert sorted(rows[i].kind for i in tips) == ["foot", "foot", "hand", "hand"]


# --- rewards ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["paper", "code"])
@pytest.mark.parametrize("term", REWARDS)
def test_rewards_are_one_at_the_reference_and_below_elsewhere(term, form):
    sim, ref = a_pose(0), a_pose(1)
    torch.testing.assert_close(term(a_frame(sim), form=form), torch.ones(N), atol=1e-5, rtol=0)
    off = term(a_frame(sim, ref=ref), form=form, alpha=0.1)
    assert ((off > 0) & (off < 1)).all()
    far = a_frame(moved(sim, 1.0, (9.0, 2.0)), ref=moved(ref, 1.0, (9.0, 2.0)))
    torch.testing.assert_close(term(far, form=form, alpha=0.1), off, atol=1e-5, rtol=0)


def test_eq_2_by_hand():
    sim = a_pose(0)
    error = torch.zeros(N, B, 3)
    error[:, 1] = torch.tensor([0.03, 0.0, 0.04])  # 5 cm of one body out of five.
    frame = a_frame(sim, ref=replace(sim, pos=sim.pos + error))
    # code: 0.0025 over 15 numbers; paper: 0.05 over 5 bodies
    close(reward.body_positions(frame, form="code"), math.exp(-100 * 0.0025 / 15))
    close(reward.body_positions(frame, form="paper"), math.exp(-100 * 0.01))
    speed = 40 * error  # 2 m/s, rad/s.
    for term, name in ((REWARDS[2], "linvel"), (REWARDS[3], "angvel")):
        frame = a_frame(sim, ref=replace(sim, **{name: getattr(sim, name) + speed}))
        close(term(frame, form="code"), math.exp(-0.1 * 4 / 15))
        close(term(frame, form="paper"), math.exp(-0.1 * 2 / 5))
    more = axis_angle_to_quat(torch.tensor([0.0, 0.6, 0.8]), torch.tensor(0.3)).expand(N, 4)
    quat = sim.quat.clone()
    quat[:, 2] = -quat_mul(more, quat[:, 2])  # The other sign is the same rotation.
    frame = a_frame(sim, ref=replace(sim, quat=quat))
    close(reward.body_rotations(frame, form="code"), math.exp(-10 * 0.09 / 5))
    close(reward.body_rotations(frame, form="paper"), math.exp(-10 * 0.3 / 5))
    terms = reward.imitation_terms("paper")
    assert [t.weight for t in terms] == [0.5, 0.3, 0.1, 0.1] and all(t.imitation for t in terms)
    assert all(t.params == {"form": "paper"} for t in terms)


def close(values: torch.Tensor, want: float) -> None:
    torch.testing.assert_close(values, torch.full_like(values, want), atol=1e-5, rtol=1e-4)


def test_the_energy_by_hand_and_who_is_exempt():
    sim = a_pose(0)
    qvel = torch.zeros(N, 6 + H)
    qvel[:, :6] = 99.0  # The root has no motors.
    qvel[:, 6], qvel[:, 8] = 2.0, -3.0
    torque = torch.zeros(N, H)
    torque[:, 0], torque[:, 2] = -5.0, 4.0
    frame = a_frame(replace(sim, qvel=qvel), age=torch.tensor([1, 3, 4]), torque=torque)
    assert reward.energy(frame).tolist() == [0.0, 0.0, 22.0]
    assert reward.energy(frame, form="paper").tolist() == [0.0, 0.0, 244.0]
    assert reward.energy(frame, exempt=0).tolist() == [22.0] * 3
    with pytest.raises(ValueError, match="torques"):
        reward.energy(a_frame(sim))


def test_the_energy_is_not_halved_by_the_prior():
    term = reward.energy_term(0.5)
    # 0.5 (r_task - 0.001 e) = 0.5 r_task - 0.0005 e
    assert 0.5 * term.weight == pytest.approx(-0.0005) and not term.imitation
    assert reward.energy_term(1.0, "paper").params["form"] == "paper"
    with refused("settings-conflict"):
        RewardTerm("energy", reward.energy, -1.0)


def test_the_roots_place_by_hand():
    sim = a_pose(0)
    error = torch.zeros(N, B, 3)
    error[:, 0] = torch.tensor([0.06, 0.0, 0.08])
    close(reward.root_position(a_frame(sim)), 1.0)
    close(reward.root_position(a_frame(sim, ref=replace(sim, pos=sim.pos + error))), math.exp(-1))


def test_prices_of_changes_by_hand_and_the_first_step_is_free():
    before, now = torch.zeros(N, H), torch.zeros(N, H)
    before[:, 0], now[:, 1] = 0.3, 0.4
    age = torch.tensor([1, 2, 9])
    frame = a_frame(a_pose(0), age=age, action=now, action_before=before)
    torch.testing.assert_close(reward.action_rate(frame), torch.tensor([0.0, 0.25 / H, 0.25 / H]))
    limits = torch.tensor([3.0, 2.0, 1.0, 1.0, 1.0, 1.0])
    frame = a_frame(a_pose(0), age=age, torque=now, torque_before=before)
    want = (0.01 + 0.04) / H
    torch.testing.assert_close(
        reward.torque_rate(frame, limits), torch.tensor([0.0, want, want]), atol=1e-7, rtol=0
    )
    with pytest.raises(ValueError, match="before"):
        reward.torque_rate(a_frame(a_pose(0)), limits)
    term = reward.cost_term(reward.torque_rate, 0.2, 0.5, limits=limits)
    assert term.name == "torque_rate" and term.weight == -0.4 and not term.imitation


def test_only_soles_that_touch_the_ground_slide():
    still = a_pose(0)
    pos, quat = torch.zeros(N, B, 3), torch.tensor([1.0, 0, 0, 0]).expand(N, B, 4)
    linvel, angvel = torch.zeros(N, B, 3), torch.zeros(N, B, 3)
    pos[:, 3:, 2] = 0.05
    pos[2, 4, 2] = 0.5  # A lifted foot.
    linvel[:, 3:, 0] = 0.3
    angvel[1, 3, 2] = 1.0  # It turns on the spot, too: the points 10 cm ahead move sideways.
    linvel[1, 4, 2] = 0.5  # A foot that rises.
    sim = replace(still, pos=pos, quat=quat, linvel=linvel, angvel=angvel)
    points = torch.tensor([[0.1, 0.0, -0.05], [0.0, 0.0, 0.05]] * 2)
    told = reward.foot_slide(a_frame(sim), torch.tensor([3, 3, 4, 4]), points)
    torch.testing.assert_close(told, torch.tensor([0.3, math.hypot(0.3, 0.1) / 2, 0.15]))


# --- early termination -----------------------------------------------------------------------------


def test_relaxed_termination_by_hand():
    sim = a_pose(0)
    apart = torch.zeros(N, B, 3)
    apart[0, 4, 0] = 3.0  # A foot far off.
    apart[1, 1, 1] = 0.3  # One body at 30 cm.
    apart[2, :4, 2] = 0.6  # All but the foot at 60 cm.
    frame = a_frame(sim, ref=replace(sim, pos=sim.pos + apart), age=torch.tensor([2, 2, 1]))
    rows = torch.arange(4)
    assert reward.bodies_too_far(frame).tolist() == [True, False, False]
    assert reward.bodies_too_far(frame, bodies=rows).tolist() == [False, False, True]
    assert reward.any_body_too_far(frame, bodies=rows).tolist() == [False, True, True]
    assert reward.any_body_too_far(frame, bodies=rows, grace=1).tolist() == [False, True, False]
    assert reward.bodies_too_far(frame, bodies=rows, grace=1).tolist() == [False, False, False]
    with pytest.raises(ValueError, match="age"):
        reward.any_body_too_far(a_frame(sim), grace=1)


def test_all_but_feet_are_all_but_feet():
    humanoid = make_humanoid(human(), generate_table(human()))
    rows, kept = humanoid.table.rows, reward.all_but_feet(humanoid).tolist()
    assert [r.kind for i, r in enumerate(rows) if i not in kept] == ["foot", "foot"]
