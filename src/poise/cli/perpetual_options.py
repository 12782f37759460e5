"""The options of `poise train perpetual`, and what they become."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import UseAppendAction, arg

from poise.cli.options import Body, Training
from poise.errors import PoiseError

if TYPE_CHECKING:
    from poise.recipes.library.folder import LibraryConfig
    from poise.recipes.perpetual import Perpetual

Goal = Literal["rotations", "keypoints"]
Termination = Literal["relaxed", "all", "code"]


@dataclass(frozen=True)
class Primitives:
    """What only the recipe perpetual knows."""

    single: bool = False
    """perpetual: one larger network in place of primitives and a composer."""
    max_primitives: Annotated[int, arg(metavar="K")] = 3
    """perpetual: train at most so many primitives, each on what the ones before it fail."""
    goal: Annotated[Goal, arg(metavar="NAME")] = "rotations"
    """perpetual: rotations tells of places and rotations, keypoints of places alone."""
    recovery: bool = True
    """perpetual: fallen and far characters learn to get up and come back; so nobody does."""
    multiplicative: bool = True
    """perpetual: a composer combines primitives; so there is one network of their size."""
    progressive: bool = True
    """perpetual: a primitive learns what earlier ones fail; so all learn with the composer."""
    termination: Annotated[Termination, arg(metavar="NAME")] = "relaxed"
    """perpetual: bodies whose mean distance ends an episode: relaxed leaves feet out, all; or code."""
    onto: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """perpetual: a motion file or MJCF body onto whose skeleton all is retargeted."""
    library_skeleton: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="RE=F")] = ()
    """perpetual: REGEX=FILE.asf, for AMC files of such names that have none beside them."""
    library_fps: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="RE=HZ")] = ()
    """perpetual: REGEX=HZ, frames per second of files of such names."""

    def reading(self) -> LibraryConfig:
        """How the files of the library are read."""
        from poise.recipes.library.folder import LibraryConfig

        rates = []
        for pattern, text in _pairs("library-fps", self.library_fps, "cmu=120"):
            try:
                rate = float(text)
            except ValueError:
                rate = math.nan
            if not 0 < rate < 10_000:
                raise PoiseError(f"--library-fps needs frames per second above 0, got '{text}'")
            rates.append((pattern, rate))
        skeletons = _pairs("library-skeleton", self.library_skeleton, "cmu-02=02.asf")
        for _, asf in skeletons:
            if not Path(asf).is_file():
                raise PoiseError("there is no such file", asf, "--library-skeleton names an ASF file")
        return LibraryConfig(skeletons=tuple(skeletons), rates=tuple(rates))

    def source(self) -> list[str]:
        """What of the library's reading tells one run from another, in words."""
        said = [f"onto {self.onto.resolve()}"] if self.onto is not None else []
        said += [f"skeleton {x}" for x in self.library_skeleton]
        return said + [f"fps {x}" for x in self.library_fps]


def _pairs(option: str, texts: tuple[str, ...], example: str) -> list[tuple[str, str]]:
    """(pattern, value) of REGEX=VALUE each; the last "=" counts, since patterns may hold some."""
    out = []
    for text in texts:
        pattern, equals, value = text.rpartition("=")
        if not (equals and pattern and value):
            hint = f"Write for example --{option} {example}"
            raise PoiseError(f"--{option} needs REGEX=VALUE, got '{text}'", hint=hint)
        out.append((pattern, value))
    return out


def settings(primitives: Primitives, training: Training, body: Body) -> Perpetual:
    """The recipe's settings; options that belong to other recipes are refused."""
    plain = Training()
    for name in ("method", "reward", "help_limit"):
        if getattr(training, name) != getattr(plain, name):
            option = name.replace("_", "-")
            raise PoiseError(f"the recipe perpetual has no --{option}", hint="Leave it out")
    if not 1 <= primitives.max_primitives <= 64:
        raise PoiseError(f"--max-primitives must lie in 1 to 64, got {primitives.max_primitives}")
    from poise.recipes.perpetual import Perpetual

    config = Perpetual(
        single=primitives.single,
        max_primitives=primitives.max_primitives,
        goal=primitives.goal,
        recovery=primitives.recovery,
        multiplicative=primitives.multiplicative,
        progressive=primitives.progressive,
        termination=primitives.termination,
        help_start=training.help_start,
        seed=training.seed,
        expert=training.expert,
        body=body.config(),
    )
    return config if training.envs is None else replace(config, num_envs=training.envs)
