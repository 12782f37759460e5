"""Run folders, policies, models and output paths from strangers, for `attack.py`.

What is changed in a run, a policy or a model is the table of `tests/jobs/test_strange_files.py`, and
what stands here beside it.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from attack_case import WALK, case, command

import poise

# Imported once, before the process of each case is forked.
import poise.cli.convert
import poise.cli.doctor
import poise.cli.eval
import poise.cli.inbetween
import poise.cli.track
import poise.jobs.runs
from poise.errors import PoiseError
from poise.formats import read_clip

_TESTS = Path(__file__).resolve().parents[1] / "tests"
sys.path += [str(_TESTS), str(_TESTS / "jobs")]
strange: Any = import_module("test_strange_files")

OLD, said, held = strange.OLD, strange.said, strange.held
NAN = float("nan")
RESUME = strange.RESUME | {
    "help that is no number": held("env/help", lambda x: x * NAN),
    "iteration -5": said("iteration", to=-5),
    "seconds that are no number": held(
        "trainer/counters", lambda x: x * NAN if x.is_floating_point() else x
    ),
}
EVAL = strange.EVAL | {
    "num_obs a list": said("num_obs", to=[335]),
    "hidden of a million twice": said("policy", "hidden", to=[1_000_000, 1_000_000]),
}


def run_with(folder: Path, file: str, change: Any) -> Path:
    """A small run with one file changed."""
    run = folder / "run"
    shutil.copytree(OLD / "imitate", run)
    strange.changed(OLD / "imitate" / file, change, run / file)
    return run


def resumed(folder: Path, change: Any) -> Any:
    """Goes on with it."""
    from poise.jobs.open import open_run
    from poise.jobs.runs import train
    from poise.learn import Until

    run = run_with(folder, "checkpoint.safetensors", change)
    return train(open_run(run).task, run, Until(iterations=9), threads=1, tensorboard=False)


def tracked(folder: Path, change: Any) -> str:
    """Uses a policy file."""
    strange.changed(OLD / "tracker.safetensors", change, folder / "policy.safetensors")
    return command(
        "track", OLD / "walk.bvh", "--policy", folder / "policy.safetensors", "-o", folder / "o"
    )


def filled(folder: Path, change: Any) -> str:
    """Uses a model file."""
    shipped = Path(poise.__file__).parent / "data/inbetween/model.safetensors"
    strange.changed(shipped, change, folder / "model.safetensors")
    return command(
        "inbetween", OLD / "walk.bvh", "--keyframes", "0,20", "--model", folder / "model.safetensors",
        "-o", folder / "out.bvh",
    )  # fmt: skip


def _each(what: str, changes: dict[str, Any], use: Any) -> None:
    for name, change in changes.items():
        case(f"{what}, {name}")(lambda f, c=change: use(f, c))  # type: ignore[misc]


_each("resume", RESUME, resumed)
_each("checkpoint", EVAL, lambda f, c: command("eval", run_with(f, "checkpoint.safetensors", c)))
_each("run file", strange.RUN, lambda f, c: command("eval", run_with(f, "run.safetensors", c)))
_each("policy", strange.POLICY, tracked)
_each("model", strange.MODEL, filled)


@case("two trainings in one run folder")
def _(folder: Path) -> Any:
    """The second one is refused while the first one holds the folder."""
    from poise.learn.checkpoint import only_writer

    run = folder / "run"
    shutil.copytree(OLD / "imitate", run)
    code = (
        "from poise.learn.checkpoint import only_writer\nfrom pathlib import Path\n"
        f"with only_writer(Path({str(run)!r})):\n print('held', flush=True)\n input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None
        other.stdout.readline()
        try:
            with only_writer(run):
                raise RuntimeError("the folder has two writers")
        finally:
            other.kill()


@case("convert onto a symbolic link")
def _(folder: Path) -> Any:
    (folder / "kept.bvh").write_text("kept")
    (folder / "link.bvh").symlink_to(folder / "kept.bvh")
    try:
        command("convert", WALK, folder / "link.bvh", "--force")
    finally:
        if not (folder / "link.bvh").is_symlink():
            raise RuntimeError("the link is gone")


@case("convert onto a named pipe")
def _(folder: Path) -> Any:
    os.mkfifo(folder / "pipe.bvh")
    return command("convert", WALK, folder / "pipe.bvh", "--force")


@case("convert below a file")
def _(folder: Path) -> Any:
    (folder / "file").write_text("no folder")
    return command("convert", WALK, folder / "file" / "x.bvh")


@case("imitate into a folder with a dot")
def _(folder: Path) -> Any:
    """Right: it is a folder. One iteration of the smallest training."""
    from poise.cli.options import places

    if places(folder / "run_v1.0") != (folder / "run_v1.0", None):
        raise RuntimeError("it was taken for a file")


@case("a clip that is changed while it is read")
def _(folder: Path) -> Any:
    """Right or refused: the file is cut to half of its bytes by another process, again and again."""
    path, data = folder / "a.bvh", WALK.read_bytes()
    path.write_bytes(data)
    code = (
        f"import os\np = {str(path)!r}\nd = open(p, 'rb').read()\nfor k in range(20000):\n"
        " with open(p, 'r+b') as f:\n  f.truncate(len(d) // 2 if k % 2 else len(d))\n  f.write(d[:9999])"
    )
    with subprocess.Popen([sys.executable, "-c", code]) as other:
        try:
            for _ in range(20):
                with suppress(PoiseError):
                    read_clip(path)
        finally:
            other.kill()


torch.set_num_threads(1)
