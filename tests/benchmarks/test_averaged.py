"""Policies whose weights are averaged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import averaged
import pytest
import torch

from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker, load_tracker, save_tracker
from poise.learn.policy import Value
from refusals import refused


@pytest.fixture(scope="module")
def both() -> tuple[Tracker, Tracker]:
    """The policy that comes with Poise, and one that began as it."""
    first = open_run(None).tracker
    other, rng = first.policy.copy(), torch.Generator().manual_seed(0)
    state = {
        k: v + 0.01 * torch.randn(v.shape, generator=rng) if k.startswith("policy/") else v
        for k, v in other.state().items()
    }
    other.load_state(state)
    about = {**first.about, "samples": first.about["samples"] + 1000}
    return first, replace(first, policy=other, about=about)


def test_every_number_is_the_mean(both: tuple[Tracker, Tracker]) -> None:
    out = averaged.averaged(both, (0.25, 0.75))
    mine, its, made = (t.policy.state() for t in (*both, out))
    for name, value in made.items():
        assert torch.allclose(value, 0.25 * mine[name] + 0.75 * its[name], atol=1e-6)
        assert value.dtype == mine[name].dtype
    assert out.about["samples"] == both[1].about["samples"]
    assert out.about["clips"] == both[0].about["clips"]


def test_the_critic_is_of_one_policy(both: tuple[Tracker, Tracker]) -> None:
    first, other = both
    assert first.value is not None
    louder = Value(other.policy, {k: 2 * v for k, v in first.value.state().items()}, "relu")
    other = replace(other, value=louder)
    for critic, wanted in ((None, first), (other, other)):
        made = averaged.averaged((first, other), (0.5, 0.5), critic).value
        assert made is not None and wanted.value is not None
        mine = wanted.value.state()
        assert all(torch.equal(v, mine[k]) for k, v in made.state().items())
    # Without one nothing is lost.
    assert averaged.averaged((replace(first, value=None), other), (0.5, 0.5)).value is None


def test_the_command_writes_a_policy(both: tuple[Tracker, Tracker], tmp_path: Path) -> None:
    files = [tmp_path / f"{name}.safetensors" for name in ("a=b", "other", "out")]
    for tracker, file in zip(both, files, strict=False):
        save_tracker(tracker, file)
    averaged.main([f"{files[0]}=0.5", f"{files[1]}=0.5", "-o", str(files[2])])
    made, wanted = load_tracker(files[2]), averaged.averaged(both, (0.5, 0.5))
    obs = torch.zeros(2, made.policy.num_obs)
    assert torch.allclose(made.policy.act(obs), wanted.policy.act(obs), atol=2e-2)


@pytest.mark.parametrize("shares", [(0.5, 0.6), (1.5, -0.5)])
def test_shares_that_make_no_mean_are_refused(
    both: tuple[Tracker, Tracker], shares: tuple[float, float]
) -> None:
    with refused("bad-weights"):
        averaged.averaged(both, shares)


def test_another_character_is_refused(both: tuple[Tracker, Tracker]) -> None:
    first, other = both
    narrow = replace(other, policy=other.policy.with_actions(3))
    with refused("bodies-differ", says="2"):
        averaged.averaged((first, narrow), (0.5, 0.5))


@pytest.mark.parametrize("text", ["policy.safetensors", "policy.safetensors=half", "=0.5"])
def test_a_policy_without_its_share_is_refused(text: str) -> None:
    with refused("option-malformed"):
        averaged.main([text, "-o", "out.safetensors"])
