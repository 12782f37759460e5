"""What `lookahead.py` is tried on: sets of clips, what goes wrong in them, budgets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from tracker import HELD_OUT, SIXTY

from poise.errors import PoiseError
from poise.formats.point_noise import smooth
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.library.files import matches, subject_of
from poise.jobs.library.folder import library_of
from poise.jobs.open import open_run
from poise.motion import Clip
from poise.motion.noise import VIDEO, perturb_clip, scaled
from poise.motion.rotations import unwrap_quats
from poise.plan import LookaheadConfig

#: Clips of sets in the folder of data: a pattern, and words that are left out.
FILES: dict[str, tuple[str, tuple[str, ...]]] = {
    "bandai": ("other/bandai_bvh/*.bvh", ("_old_", "_giant_", "_tired_", "_elderly_")),
    "bandai-test": ("other/bandai_bvh/*.bvh", ()),
    "bandai-all": ("other/bandai_bvh/*.bvh", ()),
    "cmu": ("cmu_amc/*/*.amc", ("/01/", "/02/", "/rfc/", "/usc/")),
    "dances": ("cmu_bvh/acrnn_salsa/*.bvh", tuple(f"/{k:02d}.bvh" for k in (*range(1, 8), 9, 10, 12))),
}
#: Words of the styles that are kept for the last test.
KEPT = FILES["bandai"][1]
#: Sets in the folder of clips that the policy learned from, or that were held out of it.
LIBRARIES = ("library", "held-out")
#: Hz, the low-pass of goals with noise.
CUTOFF = 4.0


@dataclass(frozen=True)
class Condition:
    """What goes wrong.

    mass, friction, gains: factors of the planner's model; the world stays as it is. push_n: N, on the
    upper trunk, in a horizontal direction that is drawn for each push. noise: strength of a video
    estimator's errors on the motion. smoothed: the motion with noise goes through a low-pass (Gaussian,
    zero-phase, `CUTOFF`). delay: actions act one control step late.
    """

    mass: float = 1.0
    friction: float = 1.0
    gains: float = 1.0
    push_n: float = 0.0
    noise: float = 0.0
    smoothed: bool = False
    delay: bool = False

    @property
    def of_planner(self) -> bool:
        """Whether it changes the model of the planner alone."""
        return (self.mass, self.friction, self.gains) != (1.0, 1.0, 1.0)


CONDITIONS: dict[str, Condition] = {
    "none": Condition(),
    **{f"mass {s}10 %": Condition(mass=f) for s, f in (("+", 1.1), ("-", 0.9))},
    **{f"friction {s}30 %": Condition(friction=f) for s, f in (("+", 1.3), ("-", 0.7))},
    **{f"gains {s}10 %": Condition(gains=f) for s, f in (("+", 1.1), ("-", 0.9))},
    "pushes": Condition(push_n=150.0),
    "delay": Condition(delay=True),
    **{
        f"noise {s:g}{', smoothed' if f else ''}": Condition(noise=s, smoothed=f)
        for s in (0.25, 0.5, 1.0)
        for f in (False, True)
    },
}


# --- clips ----------------------------------------------------------------------------------------


def clips_of(name: str, data: Path | None, library: Path | None, cache: Path) -> dict[str, Path | Clip]:
    """Clips of a set, or their files, by their names.

    Raises:
        PoiseError: the folder that holds them was not given, or holds none.
    """
    if name in LIBRARIES:
        if library is None:
            raise PoiseError(
                f"the set '{name}' needs --clips FOLDER",
                hint="See tracker/README.md",
                code="option-needs-option",
            )
        tracker = open_run(None).tracker
        found, _ = library_of(
            library, tracker.example, tracker.config.sim.control_hz, config=LibraryConfig(rates=SIXTY),
            body=tracker.config.body, cache=cache, tell=print,
        )  # fmt: skip
        held = name == "held-out"
        return {c.name: c for c in found if matches(HELD_OUT, c.name, subject_of(c.name)) == held}
    if data is None:
        raise PoiseError(f"the set '{name}' needs --data FOLDER", code="option-needs-option")
    pattern, without = FILES[name]
    files = [f for f in sorted(data.glob(pattern)) if not any(w in f.as_posix() for w in without)]
    if name == "bandai-test":
        files = [f for f in files if any(w in f.as_posix() for w in KEPT)]
    if not files:
        raise PoiseError(f"holds no clip of the set '{name}'", data, code="no-clips")
    return {f.stem: f for f in files}


def disturbed(clip: Clip, condition: Condition, seed: int) -> Clip:
    """The motion as it comes in."""
    if not condition.noise:
        return clip
    clip = perturb_clip(clip, scaled(VIDEO, condition.noise), seed)
    if not condition.smoothed:
        return clip
    rot = smooth(unwrap_quats(torch.tensor(clip.rot)).numpy(), clip.fps, CUTOFF)
    rot = rot / np.linalg.norm(rot, axis=-1, keepdims=True)
    return clip.replaced(root_pos=smooth(clip.root_pos, clip.fps, CUTOFF), rot=rot)


def budgets_of(texts: Sequence[str]) -> dict[str, LookaheadConfig]:
    """Settings by "64x12" (copies and horizon) or "192" (simulated steps for each that is made).

    Raises:
        PoiseError: something else, or too few copies.
    """
    out: dict[str, LookaheadConfig] = {}
    for text in texts:
        many, x, far = text.partition("x")
        try:
            if x:
                out[text] = replace(LookaheadConfig(), candidates=int(many), horizon=int(far))
            else:
                made = LookaheadConfig().with_budget(float(text))
                out[f"{made.candidates}x{made.horizon}"] = made
        except ValueError:
            raise PoiseError(
                f"a budget is COPIESxHORIZON or STEPS, got '{text}'", code="option-malformed"
            ) from None
    return out
