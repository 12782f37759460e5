"""The installed package: its data are in it, and nothing of one system alone is imported with it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from poise import machine

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "poise"
#: Modules that only POSIX systems have.
POSIX = ("fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog", "readline")
#: Functions that only POSIX systems, or only Linux, have.
CALLS = ("fork", "getuid", "geteuid", "killpg", "setsid", "sched_getaffinity", "nice", "uname")

IMPORT_ALL = """
import sys, os, pkgutil, importlib
hidden = {posix}
# What torch and the standard library do with them is not ours: they are imported first.
import torch, numpy, scipy, mujoco, gymnasium, asyncio, multiprocessing, subprocess, tempfile
import rich.console, tyro, websockets, jinja2
class Hide:
    def find_spec(self, name, path=None, target=None):
        if name in hidden:
            raise ModuleNotFoundError("no module named " + name, name=name)
for name in hidden:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Hide())
for name in {calls}:
    if hasattr(os, name):
        delattr(os, name)
import poise
wrong = []
for found in pkgutil.walk_packages(poise.__path__, "poise."):
    try:
        importlib.import_module(found.name)
    except ImportError as problem:
        if problem.name in hidden or problem.name is None:
            wrong.append(found.name + ": " + str(problem))
    except Exception as problem:
        wrong.append(found.name + ": " + repr(problem))
sys.exit("\\n".join(wrong) or 0)
"""


def _files() -> list[str]:
    """The files of the package that are no Python, as git knows them."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "src/poise"], cwd=ROOT, capture_output=True, check=False
    )
    if listed.returncode != 0 or not listed.stdout:
        pytest.skip("not a git checkout")
    names = [n for n in listed.stdout.decode().split("\0") if n and not n.endswith(".py")]
    return sorted(n.removeprefix("src/poise/") for n in names)


def test_every_file_of_the_package_is_in_the_wheel() -> None:
    """The patterns of pyproject.toml name every file beside the code; no wheel is built for it."""
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]
    [(package, globs)] = patterns["package-data"].items()
    assert package == "poise"
    packed = {p.relative_to(PACKAGE).as_posix() for g in globs for p in PACKAGE.glob(g) if p.is_file()}
    files = _files()
    assert {"data/walk.bvh", "data/tracker.safetensors", "py.typed"} <= set(files)
    assert [name for name in files if name not in packed] == []
    # And every pattern names something.
    assert [g for g in globs if not any(PACKAGE.glob(g))] == []


def test_every_folder_with_code_is_a_package() -> None:
    """What has no `__init__.py` is not found, and left out."""
    folders = {file.parent for file in PACKAGE.rglob("*.py")}
    assert [f.relative_to(ROOT) for f in folders if not (f / "__init__.py").is_file()] == []


def test_no_module_needs_posix_to_be_imported() -> None:
    """A fresh process without the modules and functions of POSIX imports every module of Poise."""
    code = IMPORT_ALL.format(posix=POSIX, calls=CALLS)
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT / "src")},
    )
    assert done.returncode == 0, done.stderr[-3000:]


def test_cores_where_the_system_does_not_say_which_may_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    assert machine.cores() >= 1
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert machine.cores() == (os.cpu_count() or 1)
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert machine.cores() == 1


def test_the_image_is_built_from_files_that_are_there() -> None:
    """What the Dockerfile copies exists and is not ignored, and the build's own files are among it."""
    copied = re.findall(
        r"^COPY (?!--from)(.+) \S+$", (ROOT / "Dockerfile").read_text("utf-8"), re.MULTILINE
    )
    names = {name for line in copied for name in line.split()}
    let_in = {x[1:] for x in (ROOT / ".dockerignore").read_text("utf-8").split() if x.startswith("!")}
    assert names == let_in and all((ROOT / name).exists() for name in names)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    needed = {project["readme"], *project["license-files"], "pyproject.toml", "src"}
    assert {name.split("/")[0] for name in needed} <= names
