"""What `gpu.py` measures: each piece has parts, and each part is a row of its JSON."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from tracker import HELD_OUT, SIXTY, TWINS
from tracker import config as tracker_config

import poise
from poise.body import BodyConfig
from poise.errors import PoiseError
from poise.formats import read_clip
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.open import open_run
from poise.jobs.perpetual.perpetual_run import clips_of
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import place
from poise.motion import ClipLibrary
from poise.plan import TeacherConfig
from poise.recipes import ResidualForce, build
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import build as build_tracking
from poise.sim.make import check_device
from speed.conformance import bench_conformance, run_tests
from speed.engine import bench_engine
from speed.gpu import bench_gpu
from speed.learning import bench_figure, bench_labels, bench_training

Result = dict[str, Any]
Work = Callable[[float], Result]
WALK = Path(poise.__file__).parent / "data/walk.bvh"


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        worlds: simulated at once.
        repeats: of which medians are taken.
        steps: control steps of a repeat of stepping, and twice as many of the comparison of backends.
        taught: worlds of the teacher, one after the other.
        teacher: how it looks ahead in each of them.
        tiny: networks and batches of a test's size.
    """

    worlds: int = 4096
    repeats: int = 5
    steps: int = 16
    taught: tuple[int, ...] = (16, 128)
    teacher: TeacherConfig = field(default_factory=TeacherConfig)
    tiny: bool = False


TINY = Sizes(8, 1, 2, (2,), TeacherConfig(2, 4, 3, 2, 2, 2), True)


@dataclass(frozen=True)
class Part:
    """One row to be: its name, the settings on which it depends, and what measures it until a time."""

    name: str
    settings: Result
    work: Work


class Pieces:
    """The pieces for this machine.

    Args:
        sizes: how much is measured.
        device: "cuda", or "cpu" where it is only tried.
        library: a folder of clips for the training; None trains on the walk that comes with Poise.
        onto: a motion file whose skeleton all of them get.
        checkpoint: of a training that the clock has stopped.
    """

    def __init__(
        self, sizes: Sizes, device: str, library: Path | None, onto: Path | None, checkpoint: Path
    ):
        self.sizes, self.device, self.checkpoint = sizes, device, checkpoint
        self.library, self.onto = library, onto
        self.no_warp = missing_warp(device)

    def parts(self, piece: str) -> list[Part]:
        """The parts of a piece, in their order."""
        return getattr(self, f"_{piece}")()

    def _conformance(self) -> list[Part]:
        s = self.sizes
        if self.no_warp:
            return [Part("left out", {}, lambda _: {"why": self.no_warp})]
        return [
            *(
                Part(
                    f"{cone} cone",
                    {"worlds": s.worlds, "steps": 2 * s.steps},
                    lambda until, cone=cone: bench_conformance(
                        self.imitated, s.worlds, self.device, 2 * s.steps, until, cone
                    ),
                )
                for cone in ("elliptic", "pyramidal")
            ),
            Part("tests", {}, run_tests),
        ]

    def _stepping(self) -> list[Part]:
        s = self.sizes
        settings = {"worlds": s.worlds, "repeats": s.repeats, "steps": s.steps, "tiny": s.tiny}

        def cores(until: float) -> Result:
            return bench_engine(self.imitated, 0, s.repeats, s.steps, until=until)

        def warp(until: float) -> Result:
            return bench_gpu(self.imitated, s.worlds, self.device, s.repeats, s.steps, until=until)

        found = [Part("MuJoCo on the cores", settings, cores)]
        return found if self.no_warp else [Part("MuJoCo Warp", settings, warp), *found]

    def _labels(self) -> list[Part]:
        s = self.sizes

        def part(worlds: int, networks: str) -> Part:
            config = replace(s.teacher, worlds=worlds)
            settings = {"worlds": worlds, "candidates": config.candidates, "horizon": config.horizon}
            settings |= {"hold_steps": config.hold_steps, "decisions": config.decisions}

            def work(until: float) -> Result:
                tracker = open_run(None).tracker
                task = imitation_of(tracker, [place(read_clip(WALK), tracker)])
                return bench_labels(tracker, task, config, networks, s.repeats, until)

            name = f"{worlds} worlds, physics on cpu, networks on {networks}"
            return Part(name, settings | {"repeats": s.repeats}, work)

        return [part(worlds, on) for on in self._networks for worlds in s.taught]

    def _training(self) -> list[Part]:
        s = self.sizes

        def part(physics: str, networks: str) -> Part:
            def work(until: float) -> Result:
                return bench_training(self.tracked, physics, networks, s.repeats, until)

            name = f"physics on {physics}, networks on {networks}"
            return Part(name, self._of_training | {"repeats": s.repeats}, work)

        found = [part("cpu", on) for on in self._networks]
        return found if self.no_warp else [part(self.device, self.device), *found]

    def _figure(self) -> list[Part]:
        physics, s = "cpu" if self.no_warp else self.device, self.sizes
        name = f"physics on {physics}, networks on {self.device}"
        gpu = torch.cuda.get_device_name() if self.device == "cuda" else None
        about = {"name": name, "gpu": gpu, **self._of_training}

        def work(until: float) -> Result:
            given = (self.tracked, physics, self.device, self.checkpoint, about, until)
            return bench_figure(*given, 0.0, 2) if s.tiny else bench_figure(*given)

        return [Part(name, self._of_training, work)]

    @property
    def _networks(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys((self.device, "cpu")))

    @property
    def _of_training(self) -> Result:
        clips = WALK.name if self.library is None else self.library.name
        return {"worlds": self.sizes.worlds, "clips": clips, "tiny": self.sizes.tiny}

    @cached_property
    def imitated(self) -> Imitation:
        """The task by which the engine is measured, see `engine.py`."""
        config = ResidualForce(help_limit=100.0, help_start=None, num_envs=self.sizes.worlds)
        if self.sizes.tiny:
            config = replace(config, ppo=replace(config.ppo, horizon=4, minibatch=16, norm_warmup=2))
        return build(read_clip(WALK), config)

    @cached_property
    def tracked(self) -> Imitation:
        """The task by which the tracker is trained, see `tracker.py`, with its network."""
        config, s = tracker_config(0), self.sizes
        ppo = replace(config.ppo, policy_hidden=config.single_hidden)
        if s.tiny:
            ppo = replace(ppo, horizon=4, minibatch=16, policy_hidden=(16,), value_hidden=(16,))
        config = replace(config, num_envs=s.worlds, ppo=ppo)
        if self.library is None:
            return build_tracking(ClipLibrary.of(read_clip(WALK)), config)
        how = LibraryConfig(rates=SIXTY)
        clips, _ = clips_of(self.library, BodyConfig(), HELD_OUT, TWINS, onto=self.onto, config=how)
        return build_tracking(clips, config)


def missing_warp(device: str) -> str:
    """Why physics cannot run on the device with MuJoCo Warp, "" where it can."""
    if device == "cpu":
        return "there is no GPU"
    if importlib.util.find_spec("mujoco_warp") is None:
        return "mujoco-warp is not installed"
    try:
        check_device(device)
    except PoiseError as problem:
        return str(problem)
    return ""
