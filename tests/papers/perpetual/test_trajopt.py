"""Paths that need no help: found, resumed to the bit, followed, and carried along by cyclic clips."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from poise.env import ImitationEnv, Reference
from poise.metrics import mpjpe_global
from poise.papers.perpetual.trajopt import (
    ROWS,
    LqrTeacher,
    TrajectoryOptimizer,
    TrajOptConfig,
    at_once,
    segments,
)
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force import build
from poise.recipes.residual_force_settings import ResidualForce
from poise.sim import SimConfig
from refusals import refused
from toy_human import swing

SHORT = TrajOptConfig(iterations=3, segment_s=0.3)


def search(imitation: Imitation, config: TrajOptConfig = SHORT) -> TrajectoryOptimizer:
    return TrajectoryOptimizer(imitation.reference, imitation.config.sim, config, threads=1)


def test_help_ends_where_the_motion_is_followed(make_task) -> None:
    found = search(make_task(swing(0.4, name="calm")), replace(SHORT, iterations=6, less=0.3))
    stats = [found.iterate() for _ in range(6)]
    assert found.done and stats[-1].unhelped > 0.9
    assert stats[-1].help_n < 0.2 * stats[0].help_n + 1.0 and stats[-1].error_m < 0.1


def test_what_went_astray_begins_again_on_its_reference(make_task) -> None:
    found = search(make_task(swing(0.5, name="calm")))
    found.share[:] = 0.1
    found.qpos[:, 2] += 3.0
    found.iterate()
    steps = ~torch.from_numpy(found.last)
    assert torch.equal(found.qpos[steps], found.reference.qpos[steps])
    assert found.share[0] == pytest.approx(0.1 / SHORT.less**3)


def test_a_search_that_goes_on_finds_the_same(make_task) -> None:
    imitation = make_task(swing(0.2, name="calm"), swing(0.3, speed=1.0, name="walk"))
    whole, first, then = (search(imitation) for _ in range(3))
    for _ in range(2):
        whole.iterate()
    first.iterate()
    then.load_state(first.state())
    then.iterate()
    assert all(torch.equal(a, b) for (_, a), (_, b) in zip(_exact(whole), _exact(then), strict=True))
    assert then.iteration == 2 and not then.done


def _exact(s: TrajectoryOptimizer) -> list[tuple[str, torch.Tensor]]:
    return [(k, v) for k, v in sorted(s.state().items()) if k != "seconds"]


def test_clips_are_found_as_if_each_were_alone(make_task, monkeypatch: pytest.MonkeyPatch) -> None:
    clips = swing(0.5, name="calm"), swing(0.6, speed=1.0, name="walk")
    together = search(make_task(*clips))
    monkeypatch.setattr("poise.papers.perpetual.trajopt.ROWS", 5)
    apart = search(make_task(*clips))
    assert at_once(together.lengths.tolist(), ROWS) == [[0, 1]]
    assert at_once(apart.lengths.tolist(), 5) == [[0], [1]]
    together.iterate()
    apart.iterate()
    torch.testing.assert_close(together.qpos, apart.qpos, atol=1e-9, rtol=0)


def test_clips_are_taken_as_many_at_once_as_fit() -> None:
    assert at_once([5, 5, 1, 12, 3, 7], 10) == [[0, 1], [2], [3], [4, 5]]
    assert at_once([20], 10) == [[0]]


def test_stretches_cover_every_step_once() -> None:
    lengths = np.array([61, 5, 130, 2])
    for shift in (0, 15):
        cut = segments(lengths, 30, shift)
        steps = np.concatenate([np.arange(a, b) for a, b in cut])
        ends = np.cumsum(lengths) - 1
        assert sorted(steps) == sorted(set(range(lengths.sum())) - set(ends.tolist()))
        assert (cut[:, 1] - cut[:, 0]).max() <= 38


def at(imitation: Imitation, frame: int) -> tuple[ImitationEnv, torch.Tensor]:
    env = imitation.env(2, auto_reset=False, threads=1)
    return env, env.reset_to(torch.zeros(2, dtype=torch.long), torch.full((2,), frame))


def test_on_its_path_a_character_gets_the_paths_targets(make_task) -> None:
    imitation = make_task(swing(0.5, name="calm"), method="deepmimic")
    env, obs = at(imitation, 3)
    ahead = env.reference.hinges[4].float()
    paths = search(imitation).trajectories()
    paths = replace(paths, feedback=torch.randn_like(paths.feedback))
    given = LqrTeacher(env, paths).act(obs)
    torch.testing.assert_close(given[0] + ahead, paths.target[3])
    env.backend.write(None, env.backend.state.qpos + 0.5, env.backend.state.qvel)
    pushed = LqrTeacher(env, paths, reach=0.1).act(obs)
    assert float((pushed - given).abs().max()) == pytest.approx(0.1)


def test_a_later_cycle_is_followed_like_the_first(make_task) -> None:
    imitation = make_task(swing(1.0, cyclic=True, speed=1.0, bend=0.6, name="loop"), method="deepmimic")
    found, last = search(imitation), int(imitation.reference.length[0]) - 1
    paths = found.trajectories()
    env, obs = at(imitation, 4)
    first = LqrTeacher(env, paths).act(obs)
    env, obs = at(imitation, 4 + 2 * last)
    torch.testing.assert_close(LqrTeacher(env, paths).act(obs), first, atol=1e-4, rtol=0)


def test_a_residual_force_is_left_alone(make_task) -> None:
    imitation = make_task(swing(0.5, name="calm"))
    env, obs = at(imitation, 0)
    given = LqrTeacher(env, search(imitation).trajectories()).act(obs)
    assert given.shape[1] == env.num_actions and not given[:, env.hinges :].any()


def test_settings_and_bodies_are_checked(make_task) -> None:
    with refused("out-of-range", says="less"):
        TrajOptConfig(less=1.0)
    with refused("out-of-range"):
        TrajOptConfig(steps=(1.0, 0.5))
    reference: Reference = make_task(swing(0.5, name="calm")).reference
    several = Reference(
        reference.humanoid, [reference.qpos.numpy()], 30.0, ("calm",),
        bodies=(reference.humanoid, reference.humanoid), body=[0],
    )  # fmt: skip
    with refused("single-body-only"):
        TrajectoryOptimizer(several, SimConfig())


def test_a_real_run_is_followed_without_help(data_dir: Path) -> None:
    """Inverse dynamics alone, without help, loses it in the first second."""
    from poise.formats import read_clip

    clip = read_clip(data_dir / "deepmimic_txt/humanoid3d_run.txt")
    imitation = build(clip, ResidualForce(method="deepmimic"))
    found = search(imitation, TrajOptConfig(iterations=8))
    while not found.done:
        found.iterate()
    env, obs = at(imitation, 0)
    teacher, far = LqrTeacher(env, found.trajectories()), 0.0
    for _ in range(int(imitation.reference.length[0]) - 1):
        env.step(teacher.act(obs))
        reference = env.reference.gather(env.clip, env.frame).pos
        far = max(far, float(mpjpe_global(env.pose().pos, reference).max()))
    assert far < 400.0
