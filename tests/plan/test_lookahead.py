"""Lookahead: what it predicts happens, a seed repeats it, and it goes on where the policy is lost."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from poise.env import ImitationEnv
from poise.env.stream_goal import StreamGoal
from poise.jobs.open import open_run
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.metrics.shape_points import BOX, Shapes
from poise.plan import Lookahead, LookaheadConfig
from poise.plan.lookahead import CALM, Roughness
from poise.recipes.imitation import Imitation
from poise.score import run_episodes
from refusals import refused
from toy_policy import toy_run, walk

FEW = LookaheadConfig(candidates=16, horizon=6, hold_steps=3)
#: Tracking alone decides.
PLAIN = LookaheadConfig(jerk_price=0.0, slide_price=0.0, seed=3)


@pytest.fixture(scope="module")
def tracker(tmp_path_factory: pytest.TempPathFactory) -> Tracker:
    """A policy that hardly stands."""
    return open_run(toy_run(tmp_path_factory.mktemp("run"))).tracker


@pytest.fixture(scope="module")
def task(tracker: Tracker) -> Imitation:
    return imitation_of(tracker, [place(walk(0, 40), tracker)])


def made(task: Imitation, tracker: Tracker, config: LookaheadConfig = FEW) -> Lookahead:
    assert tracker.value is not None
    copies = task.bare(rewards=True).env(config.candidates, None, False, 1, help_scale=0.0, guard=False)
    return Lookahead(copies, tracker.policy, tracker.value, config)


def alone(task: Imitation, worlds: int = 1) -> ImitationEnv:
    return task.env(worlds, None, False, 1, help_scale=0.0, guard=False)


def run(env: ImitationEnv, control: Lookahead, steps: int = 12) -> Tensor:
    """`(steps, N, A)` of what it does from the first frame on."""
    zero = torch.zeros(env.num_envs, dtype=torch.long)
    obs = env.reset_to(zero, zero)
    control.watch(env)
    out = []
    for _ in range(steps):
        out.append(control.act(obs))
        obs = env.step(out[-1]).final_obs
    return torch.stack(out)


def test_a_seed_repeats_it(task: Imitation, tracker: Tracker) -> None:
    env, control = alone(task), made(task, tracker)
    first = run(env, control)
    assert len(control.seconds) == 4 and control.steps == 4 * 16 * 6
    assert torch.equal(run(env, control), first)
    assert torch.equal(run(alone(task), made(task, tracker)), first)
    assert not torch.equal(run(env, made(task, tracker, replace(FEW, seed=1))), first)


def filtered(task: Imitation, keep: float) -> Imitation:
    return replace(task, task=replace(task.task, filter=keep))


@pytest.mark.parametrize("keep", [0.0, 0.6])
def test_what_it_predicts_happens(task: Imitation, tracker: Tracker, keep: float) -> None:
    """The character comes to where the chosen copy came; but for rounding."""
    task = filtered(task, keep)
    env = alone(task)
    control = made(task, tracker)
    zero = torch.zeros(1, dtype=torch.long)
    obs = env.reset_to(zero, zero)
    control.watch(env)
    for _ in range(2):
        predicted: list[Tensor] = []
        step = control.copies.step

        def watched(action: Tensor, step=step, seen=predicted):  # type: ignore[no-untyped-def]
            out = step(action)
            seen.append(control.copies.backend.state.qpos.clone())
            return out

        control.copies.step = watched  # type: ignore[method-assign]
        action = control.act(obs)
        control.copies.step = step  # type: ignore[method-assign]
        came = []
        for k in range(FEW.hold_steps):
            obs = env.step(action if k == 0 else control.act(obs)).final_obs
            came.append(env.backend.state.qpos[0].clone())
        paths = torch.stack(predicted)[: FEW.hold_steps]
        off = (paths - torch.stack(came)[:, None]).abs().amax((0, 2))
        assert float(off.min()) < 1e-4 < float(off.max())


def test_it_goes_on_where_the_policy_is_lost(task: Imitation, tracker: Tracker) -> None:
    zero = torch.zeros(1, dtype=torch.long)

    def off(env: ImitationEnv, acts: object) -> Tensor:
        rollouts, _ = run_episodes(lambda _: env, acts, zero, zero, cycles=1)  # type: ignore[arg-type]
        return (rollouts.pos - rollouts.ref_pos).norm(dim=-1).mean(-1)[0]

    env, control = alone(task), made(task, tracker, PLAIN)
    plain = off(alone(task), tracker.policy)
    control.watch(env)
    ahead = off(env, control)
    lost = int((plain > 0.5).nonzero()[0])
    assert float(ahead[: lost + 1].max()) < 0.5 and float(ahead.mean()) < float(plain.mean())


def test_without_anything_to_try_it_is_the_policy(task: Imitation, tracker: Tracker) -> None:
    nothing = LookaheadConfig(
        candidates=4,
        horizon=4,
        noise_range=(1e-12, 1e-12),
        smoothing=(0.0,),
        corrections=(1.0,),
        warm=0.0,
    )
    env, other = alone(task), alone(task)
    actions, zero = run(env, made(task, tracker, nothing), 8), torch.zeros(1, dtype=torch.long)
    obs = other.reset_to(zero, zero)
    for action in actions:
        torch.testing.assert_close(action, tracker.policy.act(obs), atol=1e-6, rtol=1e-5)
        obs = other.step(action).final_obs


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_its_shares_replace_those_of_a_filter(task: Imitation, tracker: Tracker, share: float) -> None:
    nothing = LookaheadConfig(
        candidates=4, horizon=4, noise_range=(1e-12, 1e-12), smoothing=(share,), corrections=(1.0,)
    )
    env, zero = alone(filtered(task, 0.6)), torch.zeros(1, dtype=torch.long)
    control = made(filtered(task, 0.6), tracker, nothing)
    # The first copy does what the policy does, and not what was asked of the others.
    assert control.keep.flatten().tolist() == pytest.approx([0.6, share, share, share])
    control.keep[0] = share
    obs = env.reset_to(zero, zero)
    control.watch(env)
    last = None
    for _ in range(6):
        own = tracker.policy.act(obs)
        given = control.act(obs)
        obs = env.step(given).final_obs
        want = own if last is None else (1 - share) * own + share * last
        torch.testing.assert_close(env.action, want, atol=1e-5, rtol=1e-4)
        last = env.action.clone()


def test_several_worlds_and_the_end_of_a_clip(task: Imitation, tracker: Tracker) -> None:
    env, control = alone(task, 2), made(task, tracker)
    env.reset_to(torch.zeros(2, dtype=torch.long), torch.tensor([0, 36]))
    control.watch(env)
    assert control.act(env.observe()).shape == (2, env.num_actions)
    # Three steps are left to the second one.
    assert control.steps == 16 * (6 + 3)


def test_a_stream_is_seen_as_far_as_it_is_known(task: Imitation, tracker: Tracker) -> None:
    control, env = made(task, tracker), alone(task)
    motion = task.reference.qpos
    for one in (env, control.copies):
        one.set_goal(StreamGoal(task.humanoid, task.reference.rate_hz, one.num_envs))
    stream = env.goal
    assert isinstance(stream, StreamGoal)
    for k in range(3):
        stream.push(motion[k])
    obs = env.reset()
    control.watch(env)
    for k in range(3, 12):
        stream.push(motion[k])
        obs = env.step(control.act(obs)).final_obs
    assert bool(obs.isfinite().all()) and control.steps == 3 * 16 * 6


BODY = Shapes(
    kind=torch.tensor([BOX]), size=torch.tensor([[0.1, 0.05, 0.02]]), pos=torch.zeros(1, 3),
    quat=torch.tensor([[1.0, 0.0, 0.0, 0.0]]), body=torch.zeros(1, dtype=torch.long), mass=None,
)  # fmt: skip


def test_prices_by_hand() -> None:
    """A foot slides at 0.3 m/s with its four lower corners on the ground; then it is jerked."""
    time = torch.arange(5) / 30.0
    pos = torch.zeros(2, 5, 1, 3)
    pos[..., 2] = 0.02
    pos[1, :, 0, 0] = 0.3 * time
    quat = torch.zeros(2, 5, 1, 4)
    quat[..., 0] = 1.0
    none = pos[0, :0]

    def rough(pos: Tensor, past: Tensor = none) -> Roughness:
        return Roughness.of(pos, quat[: len(pos), : pos.shape[1]], past, BODY, (0,), 30.0)

    still, slides = rough(pos[:1]), rough(pos)
    # 4 corners x 0.3 m/s over half of 8 points.
    torch.testing.assert_close(slides.slide, torch.tensor([[0.0] * 4, [0.3] * 4]))
    torch.testing.assert_close(slides.price(still, 0.0, 2.0), torch.tensor([0.0, 4 * 0.3 * 2.0]))
    # What slides as the reference does costs nothing.
    torch.testing.assert_close(slides.price(rough(pos[1:]), 0.0, 2.0), torch.zeros(2), atol=1e-5, rtol=0)
    pos[1, :, 0, 0] = 70.0 * time**3
    jerked = rough(pos)
    # 420 m/s^3 in both third differences, beside a calm reference and beside itself.
    torch.testing.assert_close(jerked.jerk[1], torch.full((2,), 420.0), atol=0.5, rtol=1e-3)
    calm = jerked.price(still, 0.5, 0.0)
    torch.testing.assert_close(calm, torch.tensor([0.0, 2 * 420 / CALM * 0.5]), atol=0.02, rtol=1e-3)
    same = jerked.price(rough(pos[1:]), 0.5, 0.0)
    torch.testing.assert_close(same, torch.tensor([0.0, 2 * 0.5]), atol=1e-3, rtol=1e-3)
    past = torch.full((3, 1, 3), 0.02) * torch.tensor([0.0, 0.0, 1.0])
    assert rough(pos, past).jerk.shape == (2, 5) and not rough(pos, past).jerk[0].any()
    assert not rough(pos[:, :1]).price(still, 1.0, 1.0).any()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"candidates": 3}, ("budget-too-small", "10")),
        ({"hold_steps": 20}, ("out-of-range", "hold_steps")),
        ({"noise_range": (0.3, 0.1)}, ("out-of-range", "noise_range")),
        ({"smoothing": (1.0,)}, ("out-of-range", "smoothing")),
        ({"slack": -1.0}, ("out-of-range", "slack")),
    ],
)
def test_settings_that_make_no_sense(settings: dict, words: tuple) -> None:
    with refused(*words):
        LookaheadConfig(**settings)


def test_it_needs_its_copies_and_an_environment(task: Imitation, tracker: Tracker) -> None:
    control = made(task, tracker)
    with refused("environment-missing"):
        control.act(torch.zeros(1, control.num_obs))
    with refused("count-differs"):
        Lookahead(control.copies, tracker.policy, tracker.value, LookaheadConfig())
