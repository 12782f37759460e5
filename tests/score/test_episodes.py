"""Which start frames are evaluated, and what is recorded of the help."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch

from poise.control import ExplicitResidual
from poise.env import Reference
from poise.jobs.runs import score
from poise.learn import Policy
from poise.motion import ClipLibrary
from poise.recipes import ResidualForce, build
from poise.recipes.imitation import Imitation
from poise.score import (
    Nothing,
    perturb,
    run_episodes,
    run_in_batches,
    score_rollouts,
    simulate,
    start_frames,
)
from poise.score.episodes import OFF_RAD, Spread
from refusals import refused
from toy_human import swing


def of_lengths(*lengths: int) -> Reference:
    """All that `start_frames` reads of a reference."""
    cyclic = torch.zeros(len(lengths), dtype=torch.bool)
    return cast(Reference, SimpleNamespace(length=torch.tensor(lengths), cyclic=cyclic, rate_hz=30.0))


class Always:
    """A policy that asks for the same in every world and step."""

    def __init__(self, action: torch.Tensor):
        self.action = action

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        return self.action.expand(len(obs), -1)


def test_starts_within_a_second_of_the_end_do_not_count():
    # 61 frames at 30 Hz last 2 s; a clip that is shorter than 1 s begins at its first frame alone.
    clip, start = start_frames(of_lengths(61, 3))
    assert clip.tolist() == [0] * 31 + [1]
    assert start.tolist() == [*range(31), 0]


def test_a_cycle_has_a_second_to_come_from_everywhere():
    cycle = of_lengths(31)
    cycle.cyclic[:] = True
    assert start_frames(cycle)[1].tolist() == [*range(30)]


def test_the_last_clip_that_needs_no_thinning():
    # 283 frames cost 283 * 283 / 2 = 40 044 steps, 282 cost 39 762.
    assert len(start_frames(of_lengths(282))[0]) == 252
    assert len(start_frames(of_lengths(283))[0]) == 127


@pytest.mark.parametrize("lengths", [(900,), (300, 40, 700), (50,) * 60])
def test_long_libraries_are_thinned_evenly(lengths):
    clip, start = start_frames(of_lengths(*lengths), most_frames=10_000)
    cost = 0
    for c, n in enumerate(lengths):
        mine = start[clip == c]
        assert mine[0] == 0 and int(mine.max()) <= n - 2
        assert len(mine) == 1 or len((mine[1:] - mine[:-1]).unique()) == 1
        cost += int((n - mine).sum())
    # Frame 0 of every clip is always simulated, whatever that costs.
    assert cost <= 10_000 + sum(lengths)


def record(imitation: Imitation, action: torch.Tensor):
    """Rollouts of three starts under one constant action, and a twin's wrench and poses by step."""
    clip, start = torch.zeros(3, dtype=torch.long), torch.tensor([0, 4, 9])
    policy = Always(action)
    rollouts, _ = run_episodes(lambda n: imitation.env(n, auto_reset=False), policy, clip, start)
    twin = imitation.env(3, auto_reset=False)
    obs = twin.reset_to(clip, start)
    steps = []
    for _ in range(6):
        before = twin.pose()
        obs = twin.step(policy.act(obs)).final_obs
        steps.append((before, twin.wrench, twin.pose()))
    twin.close()
    return rollouts, steps


@pytest.mark.parametrize("bodies", [(0,), (0, 3)])
def test_explicit_help_is_recorded_at_the_point_where_it_acts(bodies):
    imitation = build(
        swing(speed=1.0), ResidualForce(method="rfc-explicit", help_start=None, help_limit=30.0)
    )
    kind = ExplicitResidual(bodies=bodies, limit_n=30.0, limit_nm=30.0)
    imitation = replace(imitation, task=replace(imitation.task, residual=kind))
    action = torch.zeros(len(imitation.humanoid.hinges) + kind.dims)
    # The point lies 0.25 m ahead of each body's origin; a torque makes it turn.
    action[-kind.dims :] = torch.tensor([0.25, 0, 0, 0.1, 0, 0.2, 0, 0.5, 0]).repeat(len(bodies))
    rollouts, steps = record(imitation, action)
    far = 0.0
    for t, (before, wrench, after) in enumerate(steps, 1):
        assert wrench is not None and wrench.body == bodies
        arm = wrench.point - before.pos[:, list(bodies)]
        torch.testing.assert_close(arm.norm(dim=-1), torch.full(arm.shape[:2], 0.25), atol=1e-5, rtol=0)
        spin = torch.linalg.cross(after.angvel[:, list(bodies)], arm)
        at_point = after.linvel[:, list(bodies)] + spin
        torch.testing.assert_close(rollouts.point_vel[:, t], at_point, atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(rollouts.ang_vel[:, t], after.angvel[:, list(bodies)])
        torch.testing.assert_close(rollouts.force[:, t], wrench.force)
        far = max(far, float(spin.norm(dim=-1).max()))
    assert far > 0.05, "The point must move differently from the origin for this to tell anything."


def test_implicit_help_acts_at_the_roots_origin():
    imitation = build(swing(speed=1.0), ResidualForce(help_start=None, help_limit=30.0))
    action = torch.zeros(len(imitation.humanoid.hinges) + 6)
    action[-6:] = torch.tensor([0.3, 0, 0.2, 0, 0.5, 0.1])
    rollouts, steps = record(imitation, action)
    for t, (_, _, after) in enumerate(steps, 1):
        assert torch.equal(rollouts.point_vel[:, t, 0], after.linvel[:, 0])


def test_starts_of_another_shape_are_told():
    with refused("count-differs"):
        run_episodes(
            lambda n: pytest.fail("no environment is needed"),
            Always(torch.zeros(1)),
            torch.zeros(2, dtype=torch.long),
            torch.zeros(3, dtype=torch.long),
        )


def test_batches_give_the_same_score_and_hold_few_frames():
    clips = [swing(0.5, name="a"), swing(0.8, cyclic=True, name="b"), swing(0.3, name="c")]
    imitation = build(ClipLibrary.of(clips), ResidualForce(method="deepmimic"))
    policy = Always(torch.zeros(len(imitation.humanoid.hinges)))
    clip, start = torch.tensor([0, 1, 2, 0]), torch.tensor([0, 0, 0, 7])

    def make(worlds: int):
        return imitation.env(worlds, auto_reset=False, threads=1)

    whole, _ = run_episodes(make, policy, clip, start)
    ref = imitation.reference
    parts = list(run_in_batches(make, policy, ref, clip, start, most=30))
    assert sum(len(p.clip) for p in parts) == 4 and len(parts) == 3
    # An episode that is longer than a part is one alone.
    assert all(p.pos.shape[0] * p.pos.shape[1] <= 30 or len(p.clip) == 1 for p in parts)
    a, b = score_rollouts(whole), score_rollouts(parts)
    assert a.mpjpe_mm == pytest.approx(b.mpjpe_mm, rel=1e-6) and a.frames == b.frames
    assert [c["clip"] for c in b.per_clip] == ["a", "b", "c"] and b.episodes == 4
    only = list(run_in_batches(make, policy, ref, clip, start))
    assert len(only) == 1 and torch.equal(only[0].pos, whole.pos) and torch.equal(only[0].clip, clip)


def test_observers_watch_one_simulation_until_all_have_seen_enough():
    class Watch:
        def __init__(self, enough: int | None):
            self.enough, self.seen = enough, []

        def see(self, env, step):
            self.seen.append((step, env.frame.tolist()))
            return self.enough is not None and step >= self.enough

    imitation = build(swing(speed=1.0), ResidualForce(method="deepmimic"))
    env = imitation.env(2, auto_reset=False, threads=1)
    policy = Always(torch.zeros(env.num_actions))
    clip, start = torch.tensor([0, 0]), torch.tensor([0, 5])
    one, two = Watch(2), Watch(4)
    simulate(env, policy, env.reset_to(clip, start), 9, one, two)
    # Before the first action, and after each step; the first one does not end the other.
    assert one.seen == two.seen == [(t, [t, 5 + t]) for t in range(5)]
    ever = Watch(None)
    simulate(env, policy, env.reset_to(clip, start), 3, one, ever)
    assert len(ever.seen) == 4
    env.close()


def test_perturbed_starts_are_drawn_world_by_world():
    imitation = build(swing(2.0), ResidualForce(method="deepmimic"))
    clip, start = torch.zeros(3, dtype=torch.long), torch.tensor([0, 5, 5])

    def first(rows: list[int], trial: list[int]) -> torch.Tensor:
        env = imitation.env(len(rows), auto_reset=False, threads=1)
        exact = env.reset_to(clip[rows], start[rows]).clone()
        seen = perturb(env, clip[rows], start[rows], torch.tensor(trial))
        assert seen.shape == exact.shape and bool((seen != exact).any(1).all())
        qpos = env.backend.state.qpos.clone()
        env.close()
        return qpos

    three = first([0, 1, 2], [0, 0, 1])
    off = three[:, 7:] - imitation.reference.qpos[start, 7:]
    assert 0.7 * OFF_RAD < float(off.std()) < 1.4 * OFF_RAD
    assert torch.equal(three[:, :3], imitation.reference.qpos[start, :3].to(three))
    assert not torch.equal(three[1], three[2])
    # Which worlds are beside it changes nothing.
    assert torch.equal(first([1], [0])[0], three[1])


def test_a_spread_moves_what_it_says() -> None:
    spread = Spread(0.02, 0.05, 0.3, 0.4, heading_rad=0.2)
    rng = np.random.default_rng(0)
    qpos = torch.zeros(2000, 10, dtype=torch.float64)
    qpos[:, 3] = 1.0
    qvel = torch.zeros(2000, 9, dtype=torch.float64)
    qvel[:, 0] = 2.0
    for a, b in zip(qpos, qvel, strict=True):
        spread.move(a, b, rng)
    std = [float(x.std()) for x in (qpos[:, 7:], qpos[:, :2], qvel[:, 2], qvel[:, 3:])]
    assert std == pytest.approx([0.02, 0.05, 0.3, 0.4], rel=0.06)
    assert torch.equal(qpos[:, 2], torch.zeros(2000).double())
    # A character that turns goes where it faces.
    yaw = 2 * torch.atan2(qpos[:, 6], qpos[:, 3])
    assert float(yaw.std()) == pytest.approx((0.2**2 + 0.02**2) ** 0.5, rel=0.06)
    assert float((qvel[:, 1] - 2.0 * yaw.sin()).std()) < 0.33
    still = [qpos[0].clone(), qvel[0].clone()]
    Spread(0.0, 0.0, 0.0, 0.0).move(*still, rng)
    assert torch.allclose(still[0], qpos[0]) and torch.equal(still[1], qvel[0])


def test_a_run_is_scored_beside_doing_nothing_over_perturbed_starts():
    imitation = build(swing(1.1), ResidualForce(method="deepmimic"))
    nothing = cast(Policy, Nothing(len(imitation.humanoid.hinges)))
    card = score(imitation, nothing, {}, starts=3)
    assert card.starts == 3 and card.episodes == 3 * 4
    assert card.nothing["succ"] == card.succ and card.nothing["mpjpe_mm"] == card.mpjpe_mm
    assert card.spread["mpjpe_mm"] > 0 and not score(imitation, nothing, {}).spread
    with refused("out-of-range", says="0"):
        score(imitation, nothing, {}, starts=0)


def test_an_episode_that_goes_bad_ends_there_and_has_failed():
    imitation = build(swing(speed=1.0), ResidualForce(method="deepmimic"))
    calm = torch.zeros(len(imitation.humanoid.hinges))

    class Wild(Always):
        steps = 0

        def act(self, obs: torch.Tensor) -> torch.Tensor:
            self.steps += 1
            return super().act(obs) if self.steps < 4 else torch.full_like(super().act(obs), torch.nan)

    def of(worlds: int):
        zero = torch.zeros(worlds, dtype=torch.long)
        return run_episodes(lambda n: imitation.env(n, auto_reset=False), Wild(calm), zero, zero)[0]

    rollouts = of(1)
    assert int(rollouts.valid.sum()) == 4 and rollouts.pos.isfinite().all()
    card = score_rollouts(rollouts)
    assert card.succ == 0.0
    with refused("unstable", says="control step 3"):
        of(2)
