"""Options that several verbs share, and what they become."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import UseAppendAction, arg

from poise.errors import PoiseError

if TYPE_CHECKING:
    from poise.body import BodyConfig
    from poise.motion import Clip
    from poise.recipes import ResidualForce

#: A switch; its help states no default, which the sentence tells.
Flag = Annotated[bool, arg(help_behavior_hint="")]
Device = Annotated[str, arg(metavar="cpu|cuda")]
Method = Literal["rfc-implicit", "rfc-explicit", "deepmimic"]
Reward = Literal["world", "local"]
Rule = Literal["phc", "phc_strict", "any_25cm", "rfc_height", "s2h_root"]


#: Units that --unit knows by name, in metres.
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}


@dataclass(frozen=True)
class Reading:
    """How a motion file is read; all of it is guessed or read from the file by default."""

    skeleton: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """The ASF skeleton of an AMC motion."""
    fps: Annotated[float | None, arg(metavar="F", help_behavior_hint="")] = None
    """Frames per second."""
    unit: Annotated[str | None, arg(metavar="METRES", help_behavior_hint="")] = None
    """Metres in one unit of the file, 0.01 for example; or m, cm, mm, in."""
    up: Annotated[Literal["Y", "Z"] | None, arg(metavar="Y|Z", help_behavior_hint="")] = None
    """The file's vertical."""
    take: Annotated[str | None, arg(metavar="NAME|N", help_behavior_hint="")] = None
    """Which animation of a file that holds several (glTF, USD); by default the longest."""
    ground: Annotated[str | None, arg(metavar="METRES|auto", help_behavior_hint="")] = None
    """The floor's height, which becomes 0; auto takes the one that the soles tell."""
    swap_sides: Flag = False
    """Exchange the names of left and right joints."""
    allow_pickle: Flag = False
    """Read pickled files (AIST++ .pkl, poselib .npy) as plain arrays; no code of theirs runs."""

    smooth: Annotated[float | None, arg(metavar="HZ", help_behavior_hint="")] = None
    """Cut-off of a low-pass on jittering keypoints (TRC, C3D, CSV): 6 suits most motion."""

    def read(self, path: Path) -> Clip:
        """The clip in the file `path`."""
        from poise.motion.io import read_clip

        floor = self._floor()
        clip = read_clip(
            path,
            skeleton=self.skeleton,
            fps=self.fps,
            unit_m=self.unit_m(),
            up_axis=self.up,
            allow_pickle=self.allow_pickle,
            take=self.take,
            smooth_hz=self.smooth,
        )
        if self.swap_sides or self.ground is not None:
            from poise.kin import anatomy_of, grounded, support_of, swap_sides

            clip = swap_sides(clip) if self.swap_sides else clip
            if self.ground is not None:
                support = support_of(clip, anatomy_of(clip)) if floor is None else None
                clip = grounded(clip, support, floor)
        return clip

    def unit_m(self) -> float | None:
        """Metres in one unit of the file, None where nothing is stated."""
        if self.unit is None or self.unit in UNITS:
            return UNITS.get(self.unit or "")
        try:
            return float(self.unit)
        except ValueError:
            hint = f"Known names: {', '.join(UNITS)}"
            raise PoiseError(f"--unit needs metres or a name, got '{self.unit}'", hint=hint) from None

    def _floor(self) -> float | None:
        """The stated height of the floor in m, None where it is to be guessed or stays."""
        if self.ground is None or self.ground == "auto":
            return None
        try:
            height = float(self.ground)
        except ValueError:
            height = math.nan
        if not abs(height) < 1000.0:
            raise PoiseError(f"--ground needs a height in metres or auto, got '{self.ground}'")
        return height


@dataclass(frozen=True)
class Body:
    """What may be stated about the body that is made."""

    mass: Annotated[float | None, arg(metavar="KG", help_behavior_hint="")] = None
    """Total mass; by default that of body mass index 22 at the clip's height."""
    body: Annotated[Path | None, arg(metavar="FILE.xml", help_behavior_hint="")] = None
    """A body of your own in MJCF in place of a generated one; the clip is retargeted onto it."""
    set: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME=VALUE")] = ()
    """One value of the body, such as lfoot.kp=400 or thigh.torque=250."""

    def config(self) -> BodyConfig:
        """The settings of the body generator."""
        from poise.body import BodyConfig

        own = None if self.body is None else str(self.body)
        return BodyConfig(mass_kg=self.mass, overrides=tuple(map(override, self.set)), mjcf=own)


def check_device(name: str) -> None:
    """Refuses a device on which nothing could run, before anything is read or made."""
    if name != "cpu":
        from poise.sim import check_device

        check_device(name)


def override(text: str) -> tuple[str, float]:
    """("lfoot.kp", 400.0) from "lfoot.kp=400"."""
    name, equals, value = text.partition("=")
    hint = "Write for example --set lfoot.kp=400"
    if not equals or not name.strip():
        raise PoiseError(f"--set needs NAME=VALUE, got '{text}'", hint=hint)
    try:
        number = float(value)
    except ValueError:
        raise PoiseError(f"--set {name.strip()} needs a number, got '{value}'", hint=hint) from None
    return name.strip(), number


@dataclass(frozen=True)
class Training:
    """How long and in which way is trained."""

    minutes: Annotated[float, arg(metavar="M")] = 10.0
    """Training time in minutes, counted over all resumed runs."""
    method: Annotated[Method, arg(metavar="NAME")] = "rfc-implicit"
    """rfc-implicit and rfc-explicit help with a residual force, deepmimic does without."""
    help_limit: Annotated[float, arg(metavar="NEWTONS")] = 0.0
    """The most residual force that may be left at the end, and in N m its torque."""
    help_start: Annotated[float, arg(metavar="NEWTONS")] = 100.0
    """The most at the beginning; while episodes succeed it comes down to --help-limit."""
    reward: Annotated[Reward, arg(metavar="NAME")] = "world"
    """world asks for the place in the world, local only for the pose and the root's motion."""
    seed: Annotated[int, arg(metavar="S")] = 0
    """Seed of everything random."""
    envs: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Characters simulated at once; the recipe's number by default, mostly 512."""
    threads: Annotated[int, arg(metavar="N")] = 0
    """Threads of the physics; 0 takes every core."""
    device: Device = "cpu"
    """Where it runs: cpu, or cuda for an NVIDIA GPU (needs poise-motion[gpu])."""
    iterations: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Stop after so many iterations as well; for tests."""
    expert: Flag = True
    """Start from nothing; by default a scripted expert (inverse dynamics) is cloned first."""
    resume: Flag = False
    """Go on with the run that is in the folder."""

    def check(self) -> None:
        """Refuses numbers that make no sense, before anything is read or made."""
        if not (self.minutes > 0 and math.isfinite(self.minutes)):
            raise PoiseError(f"--minutes must be above 0, got {self.minutes:g}")
        for name, value in (("limit", self.help_limit), ("start", self.help_start)):
            if not (value >= 0 and math.isfinite(value)):
                raise PoiseError(f"--help-{name} must be a number of at least 0 newtons, got {value:g}")
        least = {"envs": 1, "threads": 0, "iterations": 1, "seed": 0}
        for name, low in least.items():
            value = getattr(self, name)
            if value is not None and not low <= value < 2**31:
                raise PoiseError(f"--{name} must be a whole number of at least {low}, got {value}")
        check_device(self.device)

    def config(self, body: Body) -> ResidualForce:
        """The recipe's settings."""
        from poise.recipes import ResidualForce

        config = ResidualForce(
            method=self.method,
            help_limit=self.help_limit,
            help_start=self.help_start,
            reward=self.reward,
            seed=self.seed,
            expert=self.expert,
            body=body.config(),
        )
        return config if self.envs is None else replace(config, num_envs=self.envs)
