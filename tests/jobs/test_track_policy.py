"""A policy as one file: the same body, the same actions; what is refused."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from poise.jobs import runs
from poise.jobs import tracker as track_policy
from poise.jobs.open import open_run
from poise.jobs.tracker import (
    KIND,
    Tracker,
    load_tracker,
    save_tracker,
)
from poise.learn import load_checkpoint, save_checkpoint
from poise.recipes import ResidualForce
from refusals import refused
from toy_policy import toy_run, walk


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toy_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def tracker(run: Path) -> Tracker:
    return open_run(run).tracker


@pytest.fixture(scope="module")
def file(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("file") / "policy.safetensors"
    save_tracker(open_run(run).tracker, path)
    return path


def test_the_body_comes_back_exactly_and_actions_to_half_precision(tracker: Tracker, file: Path) -> None:
    back = open_run(file).tracker
    assert back.humanoid.table == tracker.humanoid.table
    assert back.humanoid.identity == tracker.humanoid.identity and back.config == tracker.config
    assert back.about == json.loads(json.dumps(dict(tracker.about)))
    assert back.about["clips"] == ["first", "second"] and back.about["samples"] > 0
    assert back.example.skeleton == tracker.example.skeleton
    obs = torch.randn(64, back.policy.num_obs, generator=torch.Generator().manual_seed(0))
    want, got = tracker.policy.act(obs), back.policy.act(obs)
    # Half precision has 11 bits.
    assert float((want - got).abs().max()) < 4e-3 * float(want.abs().max())


def test_matrices_are_halved_and_statistics_are_not(tracker: Tracker, file: Path) -> None:
    tensors, meta = load_checkpoint(file)
    assert meta["kind"] == KIND and meta["recipe"] == "perpetual"
    state = tracker.policy.state()
    for name, value in state.items():
        matrix = name.startswith("policy/") and value.ndim > 1
        assert tensors[name].dtype == (torch.float16 if matrix else value.dtype)
    big = torch.full((2, 2), 1e5)
    assert track_policy.halved("policy/w", big).dtype == torch.float32


def test_the_policy_that_comes_with_poise_is_sought_among_its_data() -> None:
    import poise

    assert track_policy.SHIPPED.parent == Path(poise.__file__).parent / "data"
    assert (track_policy.SHIPPED.parent / "walk.bvh").exists()


def test_files_of_another_kind(run: Path, file: Path, tmp_path: Path) -> None:
    for path, words in (
        (tmp_path / "absent", "file-missing"),
        (tmp_path, "not-a-run"),
        (run / "policy.safetensors", "policy-without-body"),
        (run / "run.safetensors", "not-a-policy"),
    ):
        with refused(words):
            _ = open_run(path).tracker
    data = bytearray(file.read_bytes())
    data[-3] ^= 1
    (tmp_path / "damaged").write_bytes(data)
    (tmp_path / "cut").write_bytes(file.read_bytes()[:5000])
    (tmp_path / "text").write_text("no policy")
    for name in ("damaged", "cut", "text"):
        with refused("file-damaged"):
            load_tracker(tmp_path / name)


def test_other_versions_and_other_bodies(file: Path, tmp_path: Path) -> None:
    tensors, meta = load_checkpoint(file)
    path = tmp_path / "other.safetensors"
    config = meta["config"]
    for change, words in (
        ({"tracker": 99}, ("version-differs",)),
        ({"config": {**config, "unheard_of": 1}}, ("unknown-setting", "unheard_of")),
        ({"policy": {**meta["policy"], "kind": "unheard of"}}, ("unknown-choice", "unheard of")),
        ({"num_obs": 7}, ("state-differs",)),
        ({"table": {**meta["table"], "unheard_of": 1}}, ("version-differs",)),
    ):
        save_checkpoint(path, tensors, {**meta, **change})
        with refused(*words) as problem:
            load_tracker(path)
        assert "\n" not in str(problem.value)
    save_checkpoint(path, tensors, {**meta, "character": "0123"})
    with refused("bodies-differ", says="0123"):
        load_tracker(path)


def test_a_run_that_knows_one_clip_only(tmp_path: Path) -> None:
    from poise.motion import ClipLibrary

    runs.begin(tmp_path / "run", ClipLibrary.of([walk(0, 20)]), ResidualForce(num_envs=2))
    # The folder of a result leads to its run.
    for folder in (tmp_path, tmp_path / "run"):
        with refused("policy-of-own-clips"):
            _ = open_run(folder).tracker


def test_an_untrained_run(tracker: Tracker, tmp_path: Path) -> None:
    from poise.jobs.perpetual import perpetual_run
    from poise.motion import ClipLibrary

    config = replace(tracker.config, seed=3)
    perpetual_run.begin(tmp_path, ClipLibrary.of([walk(0, 20), walk(20, 40, "b")]), config)
    with refused("nothing-trained"):
        _ = open_run(tmp_path).tracker


def test_a_program_that_tracks_or_learns_starts_without_heavy_packages(file: Path) -> None:
    """They would take longer to import than the policy takes to open."""
    code = (
        "import sys; from pathlib import Path; import poise.jobs.track; "
        "from poise.jobs.open import open_run; _ = open_run(Path(sys.argv[1])).tracker; "
        "import torch; from poise.learn.adam import Adam; p = torch.nn.Parameter(torch.ones(2)); "
        "p.grad = torch.ones(2); Adam([p]).step(); "
        "heavy = ('sympy', 'torch._dynamo', 'scipy.optimize', 'scipy.spatial'); "
        "print([m for m in heavy if m in sys.modules])"
    )
    command = [sys.executable, "-c", code, str(file)]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "[]\n"
