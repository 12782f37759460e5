"""A run that goes on from a trained policy: the same weights, the whole cost, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from poise.errors import PoiseError
from poise.jobs.open import open_run
from poise.jobs.perpetual.run import begin, going_on, train
from poise.jobs.perpetual.stage_trainer import StageTrainer
from poise.jobs.tracker import load_tracker, save_tracker
from poise.learn import Until
from poise.motion import ClipLibrary
from poise.spatial import quat_mul
from toy_human import swing
from toy_library import library, tiny

ONE = tiny(single=True, style=None, expert=False, help_start=0.0)


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with the policy of a short run."""
    folder = tmp_path_factory.mktemp("first")
    train(begin(folder / "run", library(), ONE), folder / "run", Until(iterations=2), None, 1, False)
    save_tracker(open_run(folder / "run").tracker, folder / "policy.safetensors")
    return folder / "policy.safetensors"


def test_it_begins_with_the_policys_weights_and_counts_its_cost(policy: Path, tmp_path: Path) -> None:
    tracker = load_tracker(policy)
    config = going_on(tracker.config, tiny(seed=7))
    assert config.single and config.seed == 7 and not config.expert and config.trajopt is None
    imitation = begin(tmp_path, library(), config, earlier=tracker)
    stages = StageTrainer(
        imitation, tmp_path, Until(iterations=1), 1, tensorboard=False, trained=tracker.policy
    )
    started, told = stages.trainer.policy().state(), tracker.policy.state()
    assert all(torch.equal(started[k], told[k]) for k in told if "norm" not in k and "log_std" not in k)
    stages.iterate()
    stages.save()
    stages.close()
    again = open_run(tmp_path).tracker
    assert again.about["samples"] == tracker.about["samples"] + stages.trainer.samples
    assert again.about["seconds"] > tracker.about["seconds"]


def test_a_larger_library_keeps_the_policys_body(policy: Path, tmp_path: Path) -> None:
    tracker = load_tracker(policy)
    # Soles, ranges and all else of a body depend on the clips it is made from.
    back = swing(0.7, speed=-1.0, bend=2.0, name="back")
    rot = torch.tensor(back.rot)
    knee = back.skeleton.index("LeftLeg")
    # A knee that bends the wrong way.
    rot[:, knee] = quat_mul(
        rot[:, knee], torch.tensor([math.cos(0.8), 0.0, -math.sin(0.8), 0.0]).double()
    )
    more = ClipLibrary.of([*library(), back.replaced(rot=rot.numpy())])
    imitation = begin(tmp_path, more, going_on(tracker.config, tiny()), earlier=tracker)
    assert imitation.humanoid.table.rows == tracker.humanoid.table.rows
    # Additive actions are in radians, so that ranges may grow with the clips.
    added = replace(going_on(tracker.config, tiny()), action="additive")
    wide = begin(tmp_path / "added", more, added, earlier=tracker).humanoid.table.rows
    assert wide != tracker.humanoid.table.rows
    rows = [replace(r, ranges=()) for r in wide]
    assert rows == [replace(r, ranges=()) for r in tracker.humanoid.table.rows]
    train(imitation, tmp_path, Until(iterations=1), None, 1, False, trained=tracker.policy)
    again = open_run(tmp_path).tracker
    assert again.humanoid.identity == imitation.humanoid.identity
    assert again.about["samples"] > tracker.about["samples"]


def test_another_body_and_a_composer_are_refused(policy: Path, tmp_path: Path) -> None:
    tracker = load_tracker(policy)
    body = replace(tracker.humanoid, skeleton=swing(0.5, scale=1.1).skeleton)
    other = replace(tracker, humanoid=body)
    with pytest.raises(PoiseError, match="another skeleton than the policy's body"):
        begin(tmp_path / "run", library(), ONE, earlier=other)
    assert not (tmp_path / "run").exists()
    with pytest.raises(PoiseError, match="primitives and a composer"):
        going_on(replace(ONE, single=False), ONE)
