"""What a policy saw and did in every step: as the environment tells it, saved whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from poise.jobs.open import Run, open_run
from poise.score import Nothing, Transitions, record_transitions
from refusals import refused
from toy_policy import toy_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return open_run(toy_run(tmp_path_factory.mktemp("toy") / "run"))


@pytest.fixture(scope="module")
def steps(run: Run) -> Transitions:
    return run.transitions(most=4)


def test_one_episode_by_hand(run: Run, steps: Transitions) -> None:
    """The last episode, alone and step by step, has the same observations, actions and rewards."""
    policy, _ = run.trained
    env = run.task.env(1, auto_reset=False, help_scale=0.0)
    obs = env.reset_to(torch.tensor(steps.clip[-1:]), torch.tensor(steps.start[-1:]))
    own = np.flatnonzero(steps.episode == len(steps.clip) - 1)
    assert (np.diff(own) == 1).all()
    for k in own:
        assert np.allclose(steps.obs[k], obs[0], atol=1e-5)
        assert np.allclose(steps.qpos[k], env.backend.state.qpos[0], atol=1e-6)
        action = policy.act(obs)
        assert np.allclose(steps.actions[k], action[0].detach(), atol=1e-5)
        step = env.step(action)
        obs = step.final_obs
        assert steps.rewards[k] == pytest.approx(float(step.reward[0]), abs=1e-5)
        assert steps.terminated[k] == bool(step.terminated[0])
    assert np.allclose(steps.last_obs[-1], obs[0], atol=1e-5)
    env.close()


def test_every_episode_ends_once(steps: Transitions) -> None:
    ends = steps.terminated | steps.truncated
    assert ends.sum() == len(steps.clip) == 4
    assert (np.flatnonzero(ends)[:-1] + 1 == np.flatnonzero(np.diff(steps.episode)) + 1).all()
    assert not (steps.terminated & steps.truncated).any() and not (steps.failed & ~ends).any()
    assert len(steps.obs_names) == steps.obs.shape[1] and len(set(steps.obs_names)) == len(
        steps.obs_names
    )
    assert len(steps.action_names) == steps.actions.shape[1]
    assert steps.terms.shape == (len(steps.obs), len(steps.term_names))
    assert "4 episodes" in repr(steps)


def test_the_file_holds_all_of_it_without_pickles(steps: Transitions, tmp_path: Path) -> None:
    with np.load(steps.save(tmp_path / "steps.npz"), allow_pickle=False) as file:
        assert int(file["poise_transitions"]) == 1
        for name in ("obs", "actions", "rewards", "terminated", "last_obs", "qvel"):
            assert (file[name] == getattr(steps, name)).all()
        assert tuple(file["action_names"]) == steps.action_names
        assert float(file["rate_hz"]) == steps.rate_hz
    with refused("wrong-suffix"):
        steps.save(tmp_path / "steps.h5")
    with refused("cannot-write"):
        steps.save(tmp_path / "absent" / "steps.npz")


def test_noise_is_drawn_from_the_seed_and_kept(run: Run, steps: Transitions) -> None:
    one, again, other = (run.transitions(most=2, noise=0.1, seed=s) for s in (3, 3, 4))
    assert np.array_equal(one.actions, again.actions) and np.array_equal(one.obs, again.obs)
    assert not np.array_equal(one.actions[:1], other.actions[:1])
    for noise in (-1.0, float("nan")):
        with refused("out-of-range", says="noise"):
            run.transitions(most=2, noise=noise)
    with refused("out-of-range"):
        run.transitions(most=0)


def test_any_policy_can_act(run: Run) -> None:
    task = run.task
    make = lambda n: task.env(n, auto_reset=False)  # noqa: E731
    zero = torch.zeros(1, dtype=torch.long)
    found = record_transitions(make, Nothing(run.policy.num_actions), zero, zero)
    assert (found.actions == 0).all() and found.episode.max() == 0
