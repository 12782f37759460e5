"""Run folders and files of strangers: each mistake in them is one sentence, never a traceback."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from poise.cli.main import main
from poise.learn import load_checkpoint, save_checkpoint

OLD = Path(__file__).resolve().parents[1] / "fixtures/old"
NAN = float("nan")

Change = Callable[[dict[str, Tensor], dict[str, Any]], None]


def said(*keys: str | int, to: Any = ...) -> Change:
    """The metadata with one value changed, or removed."""

    def change(tensors: dict[str, Tensor], meta: dict[str, Any]) -> None:
        here: Any = meta
        for key in keys[:-1]:
            here = here[key]
        if to is ...:
            del here[keys[-1]]
        else:
            here[keys[-1]] = to

    return change


def held(name: str, to: Callable[[Tensor], Tensor] | None) -> Change:
    """The tensors with one changed, or removed."""

    def change(tensors: dict[str, Tensor], meta: dict[str, Any]) -> None:
        value = tensors.pop(name)
        if to is not None:
            tensors[name] = to(value).contiguous()

    return change


RESUME = {
    "metadata missing": said("metadata"),
    "metadata a list": said("metadata", to=[1]),
    "metadata a text": said("metadata", to="expert"),
    "metadata null": said("metadata", to=None),
    "no help": held("env/help", None),
    "short help": held("env/help", lambda x: x[:0]),
    "no random state": held("env/rng", None),
    "short random state": held("env/rng", lambda x: x[:7]),
    "zero random state": held("env/rng", torch.zeros_like),
    "frames before the clip": held("env/frame", lambda x: x - 1_000_000),
    "frames behind the clip": held("env/frame", lambda x: x + 1_000_000),
    "short counters": held("trainer/counters", lambda x: x[:3]),
    "negative counters": held("trainer/counters", lambda x: -1 - x),
    "moments of another shape": held("adam/policy/0/exp_avg", lambda x: x[:1]),
    "iteration a text": said("iteration", to="many"),
    "no config": said("config"),
}

EVAL = {
    "num_obs missing": said("num_obs"),
    "num_actions missing": said("num_actions"),
    "policy missing": said("policy"),
    "num_obs of a terabyte": said("num_obs", to=10**9),
    "num_obs a fraction": said("num_obs", to=335.0),
    "num_obs a text": said("num_obs", to="335"),
    "num_obs negative": said("num_obs", to=-335),
    "policy a list": said("policy", to=[16]),
    "hidden a text": said("policy", "hidden", to="wide"),
    "hidden of a terabyte": said("policy", "hidden", to=[10**7, 10**7]),
    "activation a list": said("policy", "activation", to=["relu"]),
    "activation unknown": said("policy", "activation", to="loud"),
    "obs_clip a text": said("policy", "obs_clip", to="5"),
    "samples a text": said("samples", to="many"),
    "seconds a text": said("seconds", to="long"),
    "help that is no number": held("env/help", lambda x: x * NAN),
    "weights that are no numbers": held("norm/mean", lambda x: x * NAN),
}

RUN = {
    "config missing": said("config"),
    "config a text": said("config", to="fast"),
    "clips missing": said("clips"),
    "clips a text": said("clips", to="walk"),
    "clips a list of texts": said("clips", to=["walk"]),
    "no clips": said("clips", to=[]),
    "ends a text": said("clips", 0, "ends", to="toe"),
    "ends of texts": said("clips", 0, "ends", to=["toe"]),
    "name a list": said("clips", 0, "name", to=["walk"]),
    "parents that go round": said("clips", 0, "parents", 0, to=3),
    "a source that is none": said("clips", 0, "source", to={}),
    "body.mjcf a number": said("config", "body", "mjcf", to=3),
    "overrides a text": said("config", "body", "overrides", to="kp"),
    "seed a text": said("config", "seed", to="3"),
    "seed too large": said("config", "seed", to=2**70),
    "method unknown": said("config", "method", to="ppo"),
    "recipe a list": said("recipe", to=["imitate"]),
    "recipe unknown": said("recipe", to="magic"),
    "1e9 steps a second": said("config", "sim", "rate_hz", to=1e9),
    "1e9 iterations of the solver": said("config", "sim", "iterations", to=10**9),
    "1e9 frames a second": said("clips", 0, "fps", to=1e9),
    "no rotations": held("0/rot", None),
    "rotations of another shape": held("0/rot", lambda x: x[:, :2]),
}

POLICY = {
    "num_obs of a terabyte": said("num_obs", to=10**9),
    "hidden of a terabyte": said("policy", "hidden", to=[10**7]),
    "about a list": said("about", to=[1]),
    "samples a text": said("about", "samples", to="many"),
    "seconds a text": said("about", "seconds", to="long"),
    "help a text": said("about", "help_n", to="none"),
    "seed a text": said("config", "seed", to="3"),
    "table a list": said("table", to=[1]),
    "1e9 steps a second": said("config", "sim", "rate_hz", to=1e9),
    "example a text": said("example", to="walk"),
}

MODEL = {
    "fps a list": said("fps", to=[30]),
    "fps zero": said("fps", to=0.0),
    "longest a list": said("longest", to=[30]),
    "past a list": said("past", to=[10]),
    "example a text": said("example", to="walk"),
    "example of texts": said("example", to=["walk"]),
    "layout a text": said("layout", to="human"),
    "sizes of a terabyte": said("config", "width", to=10**9),
}


def changed(source: Path, change: Change, target: Path) -> None:
    tensors, meta = load_checkpoint(source)
    meta = copy.deepcopy(meta)
    change(tensors, meta)
    save_checkpoint(
        target, tensors, {k: v for k, v in meta.items() if k not in ("format", "poise", "crc32")}
    )


def told(capsys: pytest.CaptureFixture[str], *argv: str | Path) -> None:
    """The command ends with 2 and one sentence."""
    capsys.readouterr()
    assert main([str(a) for a in argv]) == 2
    err = capsys.readouterr().err
    assert "Traceback" not in err and len(err.strip()) > 20 and len(err) < 1500, err


def run_with(tmp_path: Path, file: str, change: Change) -> Path:
    folder = tmp_path / "out/run"
    shutil.copytree(OLD / "imitate", folder)
    changed(OLD / "imitate" / file, change, folder / file)
    return folder


@pytest.mark.parametrize("name", RESUME)
def test_a_run_that_goes_on(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from poise.errors import PoiseError
    from poise.jobs.open import open_run
    from poise.jobs.runs import train
    from poise.learn import Until

    folder = run_with(tmp_path, "checkpoint.safetensors", RESUME[name])
    with pytest.raises(PoiseError) as problem:
        train(open_run(folder).task, folder, Until(iterations=9), threads=1, tensorboard=False)
    assert "\n" not in str(problem.value).strip() and len(str(problem.value)) < 1000


@pytest.mark.parametrize("name", EVAL)
def test_a_checkpoint(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told(capsys, "eval", run_with(tmp_path, "checkpoint.safetensors", EVAL[name]))


@pytest.mark.parametrize("name", RUN)
def test_a_run_file(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told(capsys, "eval", run_with(tmp_path, "run.safetensors", RUN[name]))


@pytest.mark.parametrize("name", POLICY)
def test_a_policy_file(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "policy.safetensors"
    changed(OLD / "tracker.safetensors", POLICY[name], file)
    told(capsys, "track", OLD / "walk.bvh", "--policy", file, "-o", tmp_path / "out")


@pytest.mark.parametrize("name", MODEL)
def test_a_model_file(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import poise

    file = tmp_path / "model.safetensors"
    shipped = Path(poise.__file__).parent / "data/inbetween/model.safetensors"
    changed(shipped, MODEL[name], file)
    told(
        capsys, "inbetween", OLD / "walk.bvh", "--keyframes", "0,20", "--model", file,
        "-o", tmp_path / "out.bvh",
    )  # fmt: skip
