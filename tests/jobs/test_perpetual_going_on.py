"""A run that goes on from a trained policy: the same weights, the whole cost, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from poise.body import BodyConfig
from poise.env.yielding import Yielding
from poise.jobs.open import open_run
from poise.jobs.perpetual.perpetual_run import begin, train
from poise.jobs.perpetual.stage_trainer import StageTrainer
from poise.jobs.tracker import Tracker, load_tracker, save_tracker
from poise.jobs.warm_start import widened
from poise.learn import Until, Value
from poise.motion import ClipLibrary
from poise.motion.rotations import quat_mul
from poise.papers.perpetual.ablations import going_on
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import build
from poise.recipes.perpetual_settings import PushPlan
from refusals import refused
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
    with refused("skeleton-differs"):
        begin(tmp_path / "run", library(), ONE, earlier=other)
    assert not (tmp_path / "run").exists()
    with refused("policy-of-primitives"):
        going_on(replace(ONE, single=False), ONE)


WIDER = {"heading": "twist", "window": (2, 4), "filter": 0.5}


def wider(tracker: Tracker, **changes: object) -> Imitation:
    config = replace(going_on(tracker.config, tiny()), **changes)
    return build(library(), config, tracker.target.table)


def test_a_wider_observation_changes_nothing_at_first(policy: Path, tmp_path: Path) -> None:
    tracker = load_tracker(policy)
    tracker = replace(tracker, config=replace(tracker.config, heading="twist"))
    known, task = wider(tracker, heading="twist"), wider(tracker, **WIDER)
    start = widened(tracker, task)
    assert start.critic is not None and tracker.value is not None
    value = Value(start.policy, start.critic, tracker.config.ppo.activation)
    narrow, wide = (t.env(3, threads=1, auto_reset=False) for t in (known, task))
    zero = torch.arange(3)
    obs, more = narrow.reset_to(zero, zero), wide.reset_to(zero, zero)
    for _ in range(4):
        action = tracker.policy.act(obs)
        torch.testing.assert_close(start.policy.act(more), action, atol=1e-5, rtol=0)
        torch.testing.assert_close(value(more), tracker.value(obs), atol=1e-4, rtol=0)
        obs = narrow.step(action).final_obs.clone()
        more = wide.step(wide.unfiltered(action)).final_obs.clone()
    assert more.shape[1] > obs.shape[1] and start.policy.num_obs == more.shape[1]
    # What is new has been measured, and is learned.
    added = start.policy.norm.std[obs.shape[1] :]
    assert bool(((added > 0) & (added < 1)).any())
    narrow.close()
    wide.close()
    write = begin(tmp_path, library(), task.config, earlier=tracker)
    stages = StageTrainer(write, tmp_path, Until(iterations=4), 1, tensorboard=False, trained=start)
    critic = stages.trainer.ppo.state()
    assert all(torch.equal(critic[k], v) for k, v in start.critic.items() if k.startswith("critic/"))
    # The critic learns alone at first.
    for _ in range(4):
        stages.iterate()
    stages.save()
    stages.close()
    again = open_run(tmp_path).tracker
    assert again.policy.num_obs == start.policy.num_obs
    first = next(v for k, v in again.policy.state().items() if k.endswith("layers.0.weight"))
    assert bool(first[:, tracker.policy.num_obs :].any())
    # It goes on widening from there; a narrower task, and another goal, are refused.
    longer = widened(again, wider(again, window=(2, 4, 8)), steps=0)
    assert longer.policy.num_obs > again.policy.num_obs
    with refused("policy-unfit", says="goal_in_4"):
        widened(again, wider(again, window=(2,)))
    with refused("policy-unfit", says="rotation_goal"):
        widened(tracker, wider(tracker, goal="keypoints"))


def test_a_policy_goes_on_while_it_is_pushed_and_sees_its_goal_give_way(
    policy: Path, tmp_path: Path
) -> None:
    tracker = load_tracker(policy)
    plan = PushPlan(newtons=(30.0, 60.0), every_s=(0.03, 0.1), level=(0.1, 0.2))
    task = wider(tracker, pushes=plan)
    start = widened(tracker, task)
    # Evaluations are without pushes, so that nothing gives way.
    assert task.task.compliance is None and not task.task.events
    env = task.env(3, threads=1, auto_reset=False)
    columns = env.columns["yielding"]
    assert columns.stop - columns.start == 4 + len(task.humanoid.hinges)
    zero = torch.zeros(3, dtype=torch.long)
    obs = env.reset_to(zero, zero)
    assert not obs[:, columns].any()
    env.close()
    # In training some is measured and seen: levels as they were drawn, and the displaced goal.
    assert float(start.policy.norm.std[columns.start]) > 0.01
    write = begin(tmp_path, library(), task.config, earlier=tracker)
    stages = StageTrainer(write, tmp_path, Until(iterations=1), 1, tensorboard=False, trained=start)
    stages.iterate()
    env = stages.trainer.env
    yielding = env.event(Yielding)
    assert (
        yielding is not None and 0.1 <= float(yielding.level.min()) < float(yielding.level.max()) <= 0.2
    )
    assert len(yielding.level.unique()) > 1 and bool(yielding.goal.offset.any())
    seen = env.observe()[:, env.columns["yielding"]]
    torch.testing.assert_close(seen[:, 0], yielding.level.float())
    torch.testing.assert_close(seen[:, 4:], yielding.goal.offset[:, 6:].float())
    stages.save()
    stages.close()
    again = open_run(tmp_path).tracker
    assert again.config.pushes == plan and again.policy.num_obs == start.policy.num_obs


def test_servos_of_more_damping_on_the_same_body(policy: Path, tmp_path: Path) -> None:
    tracker = load_tracker(policy)
    given = tracker.config.body.damping
    damped = tracker.with_damping(2.0 * given)
    for row, before in zip(damped.humanoid.table.rows, tracker.humanoid.table.rows, strict=True):
        assert row == replace(before, kd=2.0 * before.kd)
    save_tracker(damped, tmp_path / "damped.safetensors")
    again = load_tracker(tmp_path / "damped.safetensors")
    assert again.humanoid.table == damped.humanoid.table
    assert again.config.body.damping == 2.0 * given
    imitation = begin(tmp_path / "run", library(), going_on(damped.config, tiny()), earlier=damped)
    hinges = imitation.model.dof_damping[6:]
    assert hinges == pytest.approx(2.0 * tracker.humanoid.model.dof_damping[6:])
    bare = replace(tracker, config=replace(tracker.config, body=BodyConfig(damping=0.0)))
    with refused("no-damping"):
        bare.with_damping(0.1)
