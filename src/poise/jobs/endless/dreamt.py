"""What characters that went about did: motion, figures, files."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from poise.eval.card import NO_HELP
from poise.jobs.endless.config import Dream
from poise.jobs.endless.figures import Figures
from poise.jobs.endless.frames import PIECE, Body, FrameStore
from poise.jobs.result import Result, Shown
from poise.jobs.tracker import Tracker
from poise.kin import hold_feet, lowest_height
from poise.kin.fk import Kinematics
from poise.motion import Clip
from poise.motion.io import home_suffix, write_clip
from poise.motion.io.text import write_whole
from poise.version import __version__
from poise.view import Report, Shape, Track, write_report

#: s of the motion that a report shows.
SHOWN_S = 60.0


class Character(NamedTuple):
    """One character's frames: as it was simulated, and what the kinematic policy asked for."""

    done: FrameStore
    asked: FrameStore


@dataclass(frozen=True, eq=False, repr=False)
class Dreamt(Result):
    """What characters did.

    Attributes:
        tracker: the control policy. body: makes clips of coordinates.
        characters: the frames of each.
        lost, back, reached: (character, s) of every time one lost its motion, was up again, or reached a
            target.
        config: how they went about. notes: sentences.
        paths: motion files that were written on the way.
        interrupted: whether Ctrl-C ended it.
    """

    tracker: Tracker
    body: Body
    characters: tuple[Character, ...]
    lost: tuple[tuple[int, float], ...]
    back: tuple[tuple[int, float], ...]
    reached: tuple[tuple[int, float], ...]
    config: Dream
    notes: tuple[str, ...] = ()
    paths: tuple[Path, ...] = ()
    interrupted: bool = False

    @property
    def seconds(self) -> float:
        """How long the motion is."""
        return self.characters[0].done.count / self.body.fps

    @property
    def motion(self) -> Clip:
        """The first character's motion as it was simulated, on the body's skeleton."""
        return self.body.clip(self.characters[0].done.read(), "dream")

    @property
    def asked(self) -> Clip:
        """What the kinematic policy made for it, in the same frames."""
        return self.body.clip(self.characters[0].asked.read(), "asked")

    @property
    def clip(self) -> Clip:
        """The first character's motion as it is written."""
        motion = self.motion
        return hold_feet(motion, self.body.table)[0] if self.config.hold_feet else motion

    @property
    def falls(self) -> tuple[float, ...]:
        """s of every time that a character lost its motion."""
        return tuple(t for _, t in self.lost)

    @property
    def stayed_down(self) -> int:
        """How many characters had not got up at the end."""
        ends = [
            sum(i == k for i, _ in self.lost) - sum(i == k for i, _ in self.back)
            for k in range(len(self.characters))
        ]
        return sum(n > 0 for n in ends)

    @property
    def falls_per_hour(self) -> float:
        """How often a character lost its motion. One that never gets up counts until it fell."""
        first = {i: t for i, t in reversed(self.lost)}
        stays = not self.config.recover or self.tracker.recovery_clips is None
        up = [first.get(k, self.seconds) if stays else self.seconds for k in range(len(self.characters))]
        return 3600.0 * len(self.lost) / max(sum(up), 1e-9)

    @cached_property
    def figures(self) -> dict[str, Any]:
        """Slide, penetration, jerk and so on of the simulation and of what was asked for."""
        out: dict[str, Any] = {}
        for name in ("done", "asked"):
            sums = Figures(self.tracker.humanoid, self.body.fps)
            for character in self.characters:
                store: FrameStore = getattr(character, name)
                for first in range(0, store.count, PIECE):
                    sums.add(store.read(first, first + PIECE))
            out["simulated" if name == "done" else "asked"] = sums.to_dict()
        return out

    @property
    def sentence(self) -> str:
        """What became of it."""
        n = len(self.characters)
        said = f"{self.seconds:.1f} s without help" + (f", {n} characters" if n > 1 else "")
        if self.config.targets:
            said += f", {len(self.reached)} of {n * len(self.config.targets)} targets reached"
        if not self.lost:
            return f"{said}, without a fall."
        times = "once" if len(self.lost) == 1 else f"{len(self.lost)} times"
        rest = f"and {self.stayed_down} did not get up" if self.stayed_down else "and always got up"
        return f"{said}; the motion was lost {times}, first at {self.lost[0][1]:.1f} s, {rest}."

    def to_dict(self) -> dict[str, Any]:
        """The content of score.json."""

        def times(found: tuple[tuple[int, float], ...]) -> list[dict[str, float]]:
            return [{"character": i, "seconds": round(t, 3)} for i, t in found]

        # A figure has the name that it has in every score card.
        figures = {
            kind: {"jerk" if k == "jerk_m_per_s3" else k: v for k, v in found.items()}
            for kind, found in self.figures.items()
        }
        return {
            "kind": "dream", "version": __version__, "seconds": self.seconds,
            "characters": len(self.characters), "sentence": self.sentence,
            "seed": self.config.seed, "temperature": self.config.temperature,
            "controller": self.config.controller, "recover": self.config.recover,
            "past": self.config.past, "style": self.config.style, "help": asdict(NO_HELP),
            "falls": times(self.lost), "back": times(self.back), "reached": times(self.reached),
            "falls_per_hour": round(self.falls_per_hour, 2), "stayed_down": self.stayed_down,
            **figures,
        }  # fmt: skip

    def write(self, folder: Path) -> dict[str, Path]:
        """Writes score.json and report.html into a folder."""
        folder.mkdir(parents=True, exist_ok=True)
        paths = {"score": folder / "score.json", "report": folder / "report.html"}
        write_whole(paths["score"], json.dumps(self.to_dict(), indent=2) + "\n")
        write_report(self.report(), paths["report"])
        return paths

    def report(self) -> Report:
        """A page that shows the first minute of the first character, and of the others with it."""
        humanoid, fps = self.tracker.humanoid, self.body.fps
        kinematics, frames = Kinematics(humanoid.table), round(SHOWN_S * fps)

        def track(store: FrameStore, name: str) -> Track:
            state = kinematics(torch.tensor(store.read(0, frames)))
            return Track(name, state.pos.float().numpy(), state.quat.float().numpy())

        first, *others = self.characters
        sim, ref = track(first.done, "simulation"), track(first.asked, "kinematic policy")
        apart = (sim.pos - sim.pos[:, :1]) - (ref.pos - ref.pos[:, :1])
        low = lowest_height(
            humanoid.table, torch.tensor(sim.pos).double(), torch.tensor(sim.quat).double()
        )
        figures = self.figures["simulated"]
        facts = {
            "length": f"{self.seconds:.1f} s, of which {len(sim.pos) / fps:.0f} s are shown",
            "falls": f"{len(self.lost)}, {self.falls_per_hour:.1f} an hour",
            "foot slide": f"{figures['foot_slide_mm_per_s']} mm/s",
            "jerk": f"{figures['jerk_m_per_s3']} m/s^3",
            "stood still": f"{figures['still_s']} s, {figures['longest_still_s']} s at most",
            "controller": self.config.controller, "temperature": f"{self.config.temperature:g}",
            "seed": str(self.config.seed), "version": __version__,
        }  # fmt: skip
        return Report(
            title="Endless motion", subtitle=self.sentence,
            shapes=tuple(
                Shape(i, g.kind, g.size, g.pos, g.quat)
                for i, b in enumerate(humanoid.table.rows) for g in b.geoms
            ),
            bodies=humanoid.bodies, reference=ref, simulated=sim, fps=fps, force=None, torque=None,
            error_mm=np.linalg.norm(apart, axis=-1).mean(-1) * 1000,
            error_global_mm=np.linalg.norm(sim.pos - ref.pos, axis=-1).mean(-1) * 1000,
            contacts=low[:, list(humanoid.feet)].numpy() < 0.015, score={}, curve={},
            notes=(self.sentence, *self.notes), facts=facts,
            others=tuple(track(c.done, f"character {k}") for k, c in enumerate(others, 2)),
        )  # fmt: skip

    def _shown(self) -> Shown:
        return Shown(self.clip, self.asked, None, (self.sentence, *self.notes))

    def _save_all(self, folder: Path) -> dict[str, Path]:
        paths: dict[str, Path] = {}
        for name, clip in (("simulated", self.clip), ("asked", self.asked)):
            paths[name] = folder / f"{name}{home_suffix(clip)}"
            write_clip(clip, paths[name])
        return paths | self.write(folder)
