"""A policy that teaches another acts in the other's environment as it would in its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from poise.jobs.open import open_run
from poise.jobs.perpetual.distillation import PolicyTeacher, distilled, taught_by
from poise.jobs.perpetual.perpetual_run import begin, train
from poise.jobs.tracker import Tracker
from poise.learn import Until
from poise.recipes.body_shapes import BodyShapes
from poise.recipes.perpetual import build
from poise.recipes.perpetual_settings import Perpetual
from refusals import refused
from toy_library import PLAIN, library, tiny


@pytest.fixture(scope="module")
def teacher(tmp_path_factory: pytest.TempPathFactory) -> Tracker:
    folder = tmp_path_factory.mktemp("teacher")
    config = tiny(single=True, action="additive", filter=0.5, window=(2, 4), **PLAIN)
    imitation = begin(folder / "run", library(), config)
    train(imitation, folder / "run", Until(iterations=2), threads=1, tensorboard=False)
    return open_run(folder / "run").tracker


def driven(teacher: Tracker, config: Perpetual, by_teacher: bool) -> torch.Tensor:
    """Places of all bodies over 12 steps `(12, N, B, 3)`."""
    env = build(library(), config, teacher.humanoid.table).env(4, 5, False, threads=1)
    acts = PolicyTeacher(env, teacher) if by_teacher else teacher.policy
    obs, places = env.reset_to(torch.tensor([0, 1, 2, 1]), torch.tensor([0, 3, 2, 0])), []
    for _ in range(12):
        obs = env.step(acts.act(obs)).obs.clone()
        places.append(env.pose().pos.clone())
    env.close()
    return torch.stack(places)


def test_it_drives_joints_as_in_its_own_environment(teacher: Tracker) -> None:
    own = driven(teacher, teacher.config, False)
    for changes in ({}, {"goal": "keypoints"}, {"goal": "keypoints", "filter": 0.3}):
        config = taught_by(teacher.config, **changes)
        assert (config.action == "absolute") == bool(changes)
        assert (driven(teacher, config, True) - own).abs().max() < 1e-3, changes


def test_a_keypoint_policy_is_distilled_and_trained(teacher: Tracker, tmp_path: Path) -> None:
    config = taught_by(teacher.config, goal="keypoints")
    imitation = begin(tmp_path / "run", library(), config, earlier=teacher)
    start = distilled(teacher, imitation, threads=1)
    assert start.critic is not None
    train(imitation, tmp_path / "run", Until(iterations=1), threads=1, tensorboard=False, trained=start)
    learned = open_run(tmp_path / "run").tracker
    assert learned.config.goal == "keypoints"
    assert learned.policy.num_obs == start.policy.num_obs < teacher.policy.num_obs


def test_what_it_cannot_teach_is_refused(teacher: Tracker) -> None:
    several = taught_by(teacher.config, shapes=BodyShapes(count=2))
    env = build(library(), several, teacher.humanoid.table).env(4, threads=1)
    with refused("single-body-only"):
        PolicyTeacher(env, teacher)
    env.close()
    heavy = replace(teacher.config, body=replace(teacher.config.body, mass_kg=90.0))
    env = build(library(), heavy).env(4, threads=1)
    with refused("bodies-differ"):
        PolicyTeacher(env, teacher)
    env.close()
