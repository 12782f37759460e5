"""The folder of clips that a recipe learns from, and how its files are read."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import UseAppendAction, arg

from poise.cli.options import Flag
from poise.errors import PoiseError

if TYPE_CHECKING:
    from poise.jobs.library.clips import LibraryConfig


@dataclass(frozen=True)
class Library:
    """The folder that inbetween and perpetual learn from."""

    library: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """The folder of clips."""
    hold_out: Annotated[str | None, arg(metavar="REGEX", help_behavior_hint="")] = None
    """Clips with matching names are not learned from; inbetween keeps them for validation figures."""
    never: Annotated[str | None, arg(metavar="REGEX", help_behavior_hint="")] = None
    """Clips with matching names are not used at all."""
    onto: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """A motion file (for perpetual also an MJCF body); all is retargeted onto its skeleton."""
    library_skeleton: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="RE=F")] = ()
    """REGEX=FILE.asf, for AMC files of such names that have none beside them."""
    library_fps: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="RE=HZ")] = ()
    """REGEX=HZ, frames per second of files of such names."""
    mirror: Flag = False
    """Learn from every clip in a mirror, too."""
    backwards: Annotated[str | None, arg(metavar="REGEX", help_behavior_hint="")] = None
    """perpetual: learn clips with matching names backwards, too."""

    def folder(self, recipe: str) -> Path:
        """The folder.

        Raises:
            PoiseError: none was given, or a pattern is no regular expression.
        """
        if self.library is None:
            hint = f"Write poise train {recipe} --library DIR -o RUNDIR"
            raise PoiseError(f"the recipe {recipe} needs --library", hint=hint, code="argument-missing")
        for name, text in (
            ("hold-out", self.hold_out),
            ("never", self.never),
            ("backwards", self.backwards),
        ):
            try:
                re.compile(text or "")
            except re.error as problem:
                raise PoiseError(
                    f"--{name} is no regular expression ({problem})", code="bad-regex"
                ) from None
        return self.library

    def reading(self) -> LibraryConfig:
        """How the files of the library are read."""
        from poise.jobs.library.clips import LibraryConfig

        rates = []
        for pattern, text in _pairs("library-fps", self.library_fps, "cmu=120"):
            try:
                rate = float(text)
            except ValueError:
                rate = math.nan
            if not 0 < rate < 10_000:
                raise PoiseError(
                    f"--library-fps needs frames per second above 0, got '{text}'",
                    code="option-malformed",
                )
            rates.append((pattern, rate))
        skeletons = _pairs("library-skeleton", self.library_skeleton, "cmu-02=02.asf")
        for _, asf in skeletons:
            if not Path(asf).is_file():
                raise PoiseError(
                    "there is no such file",
                    asf,
                    "--library-skeleton names an ASF file",
                    code="file-missing",
                )
        back = () if self.backwards is None else (self.backwards,)
        return LibraryConfig(
            skeletons=tuple(skeletons), rates=tuple(rates), mirror=self.mirror, backwards=back
        )

    def source(self) -> list[str]:
        """What of the library's reading tells one run from another, in words."""
        said = [f"onto {self.onto.resolve()}"] if self.onto is not None else []
        said += [f"skeleton {x}" for x in self.library_skeleton]
        said += [f"fps {x}" for x in self.library_fps]
        said += ["with mirror images"] if self.mirror else []
        return said + ([f"backwards {self.backwards}"] if self.backwards else [])


def _pairs(option: str, texts: tuple[str, ...], example: str) -> list[tuple[str, str]]:
    """(pattern, value) of REGEX=VALUE each; the last "=" counts, since patterns may hold some."""
    out = []
    for text in texts:
        pattern, equals, value = text.rpartition("=")
        if not (equals and pattern and value):
            hint = f"Write for example --{option} {example}"
            raise PoiseError(
                f"--{option} needs REGEX=VALUE, got '{text}'", hint=hint, code="option-malformed"
            )
        out.append((pattern, value))
    return out
