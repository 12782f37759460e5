"""A run that goes on from a trained policy: the same weights, the whole cost, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from toy_library import library, tiny

from poise.errors import PoiseError
from poise.learn import Until
from poise.recipes.perpetual.run import Earlier, begin, going_on, train
from poise.recipes.perpetual.stages import Course
from poise.recipes.track.policy import export_policy, policy_of_run

ONE = tiny(single=True, style=None, expert=False, help_start=0.0)


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with the policy of a short run."""
    folder = tmp_path_factory.mktemp("first")
    train(begin(folder / "run", library(), ONE), folder / "run", Until(iterations=2), None, 1, False)
    export_policy(folder / "run", folder / "policy.safetensors")
    return folder / "policy.safetensors"


def test_it_begins_with_the_policys_weights_and_counts_its_cost(policy: Path, tmp_path: Path) -> None:
    from poise.recipes.track.policy import load_tracker

    tracker = load_tracker(policy)
    config = going_on(tracker.config, tiny(seed=7))
    assert config.single and config.seed == 7 and not config.expert and config.paths is None
    cost = tracker.about["samples"], tracker.about["seconds"]
    earlier = Earlier(*cost, tracker.humanoid.identity)
    imitation = begin(tmp_path, library(), config, earlier=earlier)
    course = Course(
        imitation, tmp_path, Until(iterations=1), 1, tensorboard=False, trained=tracker.policy
    )
    started, told = course.trainer.policy().state(), tracker.policy.state()
    assert all(torch.equal(started[k], told[k]) for k in told if "norm" not in k and "log_std" not in k)
    course.iterate()
    course.save()
    course.close()
    again = policy_of_run(tmp_path)
    assert again.about["samples"] == tracker.about["samples"] + course.trainer.samples
    assert again.about["seconds"] > tracker.about["seconds"]


def test_another_body_and_a_composer_are_refused(policy: Path, tmp_path: Path) -> None:
    other = Earlier(1, 1.0, "another body")
    with pytest.raises(PoiseError, match="moves the body 'another body'"):
        begin(tmp_path / "run", library(), ONE, earlier=other)
    assert not (tmp_path / "run").exists()
    with pytest.raises(PoiseError, match="primitives and a composer"):
        going_on(replace(ONE, single=False), ONE)
