"""One way to open whatever was trained."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

import poise
from poise.jobs.open import open_run
from poise.jobs.run_file import RUN_FILE
from poise.learn import load_checkpoint, save_checkpoint
from poise.recipes import ResidualForce
from poise.recipes.perpetual_settings import Perpetual
from refusals import refused
from toy_policy import toy_run

OLD = Path(__file__).resolve().parents[1] / "fixtures/old"


def test_a_result_leads_to_its_run(tmp_path: Path) -> None:
    shutil.copytree(OLD / "imitate", tmp_path / "out/run")
    run = open_run(tmp_path / "out")
    assert run.path == tmp_path / "out/run" and run.recipe == "residual-force"
    assert repr(run) == f"Run('{run.path}', residual-force)" and isinstance(run.config, ResidualForce)
    assert run.policy.num_obs == run.task.env(1, threads=1).num_obs and len(run.curve["samples"])
    few = run.evaluate(most=3)
    assert few.card.episodes == 3
    one = run.episode(0, 5)
    assert one.card.episodes == 1 and one.recordings[0].start == 5
    source = run.task.library.clips[0]
    motion = run.clip(source.name)
    assert motion.skeleton == source.skeleton and motion.frames == source.frames
    for ask, words in (
        (lambda: run.clip("nobody"), ("unknown-clip", "nobody")),
        (lambda: run.episode(1), ("index-outside", "1")),
        (lambda: run.episode(0, 10_000), ("frame-outside", "10000")),
        (lambda: run.tracker, ("policy-of-own-clips",)),
        (lambda: run.model, ("wrong-file-kind",)),
    ):
        with refused(*words):
            ask()


def test_policy_and_network_files() -> None:
    tracker = open_run(OLD / "tracker.safetensors")
    assert tracker.recipe == "perpetual" and isinstance(tracker.config, Perpetual)
    assert tracker.policy is tracker.tracker.policy and tracker.curve == {}
    with refused("not-a-run"):
        _ = tracker.task
    for path in ("data/inbetween", "data/inbetween/model.safetensors"):
        network = open_run(Path(poise.__file__).parent / path)
        assert network.recipe == "inbetween" and network.model.fps > 0
        with refused("wrong-file-kind"):
            _ = network.tracker


@pytest.mark.parametrize("goal", ["rotations", "keypoints"])
def test_the_body_of_a_run_is_kept_exactly(tmp_path: Path, goal: str) -> None:
    toy_run(tmp_path, goal)
    kept = open_run(tmp_path).tracker
    tensors, meta = load_checkpoint(tmp_path / RUN_FILE)
    for name in ("body", "format", "poise", "crc32"):
        del meta[name]
    save_checkpoint(tmp_path / RUN_FILE, tensors, meta)
    made = open_run(tmp_path).tracker
    assert kept.humanoid.table == made.humanoid.table
    assert kept.humanoid.identity == made.humanoid.identity
    assert kept.config == made.config and kept.about == made.about
    assert kept.example.skeleton == made.example.skeleton
    for field in ("jnt_range", "opt", "actuator_gainprm", "body_mass", "geom_contype"):
        a, b = getattr(kept.humanoid.model, field), getattr(made.humanoid.model, field)
        assert (a.timestep == b.timestep) if field == "opt" else (a == b).all()
    for k, v in made.policy.state().items():
        assert torch.equal(kept.policy.state()[k], v)
