"""`poise doctor`: what works on this machine; `poise doctor CLIP`: what is wrong with a motion."""

from __future__ import annotations

import contextlib
import os
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib import import_module, metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

from rich.text import Text
from tyro.conf import OmitArgPrefixes, Positional, arg

from poise import __version__
from poise.cli.answer import Answer
from poise.cli.console import out, say
from poise.cli.folder import each
from poise.cli.options import Flag, Reading
from poise.errors import PoiseError
from poise.jobs.keep import claimed
from poise.machine import cores

State = Literal["ok", "missing", "optional"]
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome", "firefox")
_SPEED_ENVS, _SPEED_S = 64, 0.5


@dataclass(frozen=True)
class Check:
    """One line: what was looked for, whether it is there, what was found, what to do if not."""

    name: str
    state: State
    found: str
    todo: str = ""


@dataclass(frozen=True)
class Options:
    """Say what is wrong with a motion, and mend it; without a clip, what works on this machine."""

    clip: Annotated[Positional[Path | None], arg(metavar="[CLIP]", help_behavior_hint="")] = None
    """A motion file or a folder of them: trembling, sliding, floating, sinking, jumps, flips, bones."""
    fix: Flag = False
    """Mend what kinematics can mend, and write the result to OUT."""
    path: Literal["auto", "keep", "mend"] = "auto"
    """With --fix: keep leaves the root's path; mend takes off it what standing feet slip in common; auto
    does so where both feet tell the same drift."""
    rest_pose: Flag = False
    """Write it with a rest pose that other tools understand: a T-pose with all rotations at zero. The
    motion stays; without --fix nothing else is changed."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="OUT", help_behavior_hint="")] = None
    """The mended motion on the same skeleton; its suffix names the format. For a folder a folder."""
    force: Flag = False
    """Write over files that are there."""
    json: Flag = False
    """Print one JSON document and nothing else on stdout, see docs/cli.md."""
    reading: OmitArgPrefixes[Reading] = field(default_factory=Reading)


def run(options: Options, argv: Sequence[str]) -> Answer:
    """For a clip see `doctor_motion`; for the machine exit code 0 if all is there, else 1."""
    if options.clip is not None:
        from poise.cli.doctor_motion import run_on

        if not options.clip.is_dir():
            return run_on(options.clip, options)
        o, folder = options, options.out

        def one(path: Path, name: str) -> Answer:
            return run_on(path, replace(o, out=None if folder is None else folder / f"{name}.bvh"))

        with contextlib.nullcontext() if folder is None else claimed(folder):
            return each("doctor", (options.clip,), folder, one)
    if options.fix or options.rest_pose or options.out is not None:
        raise PoiseError("no clip was given", hint="Write poise doctor CLIP --fix -o OUT")
    checks = [check() for check in CHECKS]
    ready = all(c.state != "missing" for c in checks)
    wide = max(len(c.name) for c in checks)
    styles = {"ok": "green", "missing": "bold red", "optional": "yellow"}
    for c in checks:
        todo = f" ({c.todo})" if c.todo else ""
        line = Text.assemble((f"{c.state:<9}", styles[c.state]), f"{c.name:<{wide}}  {c.found}{todo}")
        out().print(line, soft_wrap=True)
    say("This machine is ready." if ready else "Something needed is missing; see above.")
    facts = {"poise": __version__, "ready": ready, "checks": [asdict(c) for c in checks]}
    return Answer(facts, exit_code=0 if ready else 1)


def python() -> Check:
    """Python's version."""
    good = sys.version_info >= (3, 11)
    found = f"{platform.python_version()} ({platform.python_implementation()})"
    return Check("python", "ok" if good else "missing", found, "" if good else "install Python 3.11")


def machine() -> Check:
    """The system, the cores this process may use, the memory."""
    count = cores()
    memory = ""
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        memory = f", {total / 2**30:.1f} GiB of memory"
    named = f"{platform.system()} {platform.machine()}"
    return Check("machine", "ok", f"{named}, {count} core{'' if count == 1 else 's'}{memory}")


def package(module: str, name: str, todo: str, needed: bool = True) -> Callable[[], Check]:
    """A check that `module` can be imported; `name` is its distribution."""

    def check() -> Check:
        absent: State = "missing" if needed else "optional"
        try:
            import_module(module)
        except Exception as problem:
            # A package that is there but broken says so in its own words.
            there = "not installed" if isinstance(problem, ModuleNotFoundError) else str(problem)
            return Check(module, absent, " ".join(there.split())[:120], todo)
        try:
            return Check(module, "ok", metadata.version(name))
        except metadata.PackageNotFoundError:
            return Check(module, "ok", "version unknown")

    return check


def cuda() -> Check:
    """A GPU that torch can use."""
    try:
        import torch
    except ImportError:
        return Check("cuda", "optional", "torch is missing", "install torch first")
    if torch.cuda.is_available():
        name = torch.cuda.get_device_name(0)
        if find_spec("mujoco_warp") is None:
            fix = "pip install 'poise-motion[gpu]' for --device cuda"
            return Check("cuda", "optional", f"{name}, but no mujoco-warp", fix)
        return Check("cuda", "ok", name)
    return Check("cuda", "optional", "no GPU", "everything runs on the CPU as well")


def browser() -> Check:
    """A browser for the reports."""
    found = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    if found:
        return Check("browser", "ok", found)
    return Check("browser", "optional", "none found", "open report.html on any other machine")


def cache() -> Check:
    """A folder for what can be made again."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "poise"
    place = folder
    while not place.exists() and place != place.parent:
        place = place.parent
    try:
        with tempfile.TemporaryFile(dir=place):
            return Check("cache", "ok", str(folder))
    except OSError as problem:
        why = f"{folder} cannot be written ({problem.strerror})"
        return Check("cache", "optional", why, "set XDG_CACHE_HOME to a folder that can")


def speed() -> Check:
    """Steps per second of the physics, with the body of the policy that comes with Poise."""
    try:
        import torch

        from poise.jobs.open import open_run
        from poise.sim import CpuBackend, SimConfig, alone

        humanoid = open_run().tracker.humanoid
        backend = CpuBackend(alone(humanoid), _SPEED_ENVS)
    except Exception as problem:
        said = f"{type(problem).__name__}: {problem}"
        return Check("physics", "missing", " ".join(said.split())[:120], "install Poise again")
    qpos = torch.tensor(humanoid.model.qpos0).repeat(_SPEED_ENVS, 1)
    qpos[:, 2] = 1.0
    backend.write(None, qpos, torch.zeros(_SPEED_ENVS, humanoid.model.nv))
    steps, start = 0, time.perf_counter()
    while (spent := time.perf_counter() - start) < _SPEED_S:
        backend.step(SimConfig().substeps)
        steps += _SPEED_ENVS
    fine = bool(torch.isfinite(backend.state.qpos).all())
    backend.close()
    hinges = len(humanoid.hinges)
    found = f"{steps / spent:,.0f} control steps/s with {_SPEED_ENVS} bodies of {hinges} hinges"
    if fine:
        return Check("physics", "ok", found)
    return Check("physics", "missing", "the simulation diverged", "install mujoco again")


CHECKS: tuple[Callable[[], Check], ...] = (
    python,
    machine,
    package("torch", "torch", "pip install torch"),
    package("mujoco", "mujoco", "pip install 'mujoco>=4.0'"),
    package("mujoco.batch", "mujoco", "pip install --upgrade 'mujoco>=4.0'"),
    package("tensorboard", "tensorboard", "pip install tensorboard"),
    speed,
    cache,
    cuda,
    package("mujoco_warp", "mujoco-warp", "pip install mujoco-warp, for physics on a GPU", needed=False),
    browser,
)
