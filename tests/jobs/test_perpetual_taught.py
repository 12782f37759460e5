"""A perpetual run with a teacher: it learns, stops and goes on bit for bit, also from a policy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from poise.jobs.open import open_run
from poise.jobs.perpetual.perpetual_run import begin, resume, train
from poise.jobs.warm_start import widened
from poise.learn import LATEST, LessonConfig, Until, load_checkpoint
from poise.papers.perpetual.ablations import going_on
from poise.plan import TeacherConfig
from poise.recipes.perpetual_settings import Perpetual
from toy_library import PLAIN, library, tiny

TEACHER = TeacherConfig(worlds=2, candidates=4, horizon=3, hold_steps=2, best=2, decisions=2)
LESSONS = LessonConfig(kept=64, batches=2, batch=4)


def settings(**changes: object) -> Perpetual:
    given = {"single": True, "teacher": TEACHER, "lessons": LESSONS, "evaluate_every": 3}
    return tiny(**(PLAIN | given | changes))


def go_on(folder: Path, config: Perpetual, stop: int = 0) -> dict[str, torch.Tensor]:
    """Trains four iterations, with a stop after `stop` of them; the last checkpoint."""
    until = Until(iterations=4)
    if stop:
        imitation = begin(folder, library(), config)
        train(imitation, folder, until, lambda p: p.iteration < stop, threads=1, tensorboard=False)
    imitation = resume(folder, config) if stop else begin(folder, library(), config)
    train(imitation, folder, until, threads=1, tensorboard=False)
    return load_checkpoint(folder / LATEST)[0]


def test_it_is_stopped_and_goes_on_bit_for_bit(tmp_path: Path) -> None:
    once, twice = go_on(tmp_path / "once", settings()), go_on(tmp_path / "twice", settings(), 2)
    assert once.keys() == twice.keys() and "student/teacher/rng" in once
    unlike = [k for k, v in once.items() if not torch.equal(v.nan_to_num(-1), twice[k].nan_to_num(-1))]
    # Seconds.
    assert unlike == ["trainer/counters"]
    log = (tmp_path / "once" / "log.csv").read_text().splitlines()
    assert "update/lesson_loss" in log[0] and len(log) == 5


def test_a_policy_is_taught_that_observed_less(tmp_path: Path) -> None:
    first = tiny(single=True, action="additive", heading="twist", **PLAIN)
    imitation = begin(tmp_path / "first", library(), first)
    train(imitation, tmp_path / "first", Until(iterations=2), threads=1, tensorboard=False)
    tracker = open_run(tmp_path / "first").tracker
    config = going_on(tracker.config, settings()).taught()
    assert config.heading == "hips" and config.filter > 0 and config.teacher is not None
    config = replace(config, teacher=TEACHER, lessons=LESSONS, num_envs=4)
    imitation = begin(tmp_path / "taught", library(), config, earlier=tracker)
    start = widened(tracker, imitation, 0)
    train(
        imitation, tmp_path / "taught", Until(iterations=2), threads=1, tensorboard=False, trained=start
    )
    taught = open_run(tmp_path / "taught").tracker
    assert taught.config.filter == config.filter and taught.policy.num_obs > tracker.policy.num_obs
