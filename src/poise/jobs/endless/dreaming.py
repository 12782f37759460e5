"""A character that goes about without end: a kinematic policy says what comes next, and a control policy
that knows many motions does it (Residual Force Control, section 5), without help and without training.

made = dream(60, "runs/endless")
made.clip, made.falls, made.save("out.bvh")
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from poise.env import Acts, ImitationEnv
from poise.env.goals import EndlessGoal
from poise.errors import PoiseError
from poise.eval import simulate
from poise.jobs.endless.model import GeneratorModel, load_generator
from poise.jobs.open import open_run
from poise.jobs.result import Result, Shown
from poise.jobs.track.controllers import look_ahead
from poise.jobs.track.placement import place
from poise.jobs.track.tracking import imitation_of
from poise.jobs.tracker import Tracker
from poise.kin import hold_feet, qpos_to_clip
from poise.motion import Clip
from poise.motion.io import home_suffix, write_clip
from poise.plan import LookaheadConfig
from poise.settings import changed, validate

#: Is told what is done, and how many control steps of how many.
Show = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Dream:
    """How a character goes about.

    Attributes:
        temperature: deviation of what the kinematic policy draws; below 1 motion is more usual.
        seed: of all draws.
        controller: the policy looks ahead before it acts, or acts at once.
        lookahead: how it looks ahead; its seed is `seed`.
        recover: a character that has fallen gets up and goes on.
        threads: cores of lookahead, 0 is all of them.
    """

    temperature: float = 1.0
    seed: int = 0
    controller: Literal["lookahead", "policy"] = "lookahead"
    lookahead: LookaheadConfig = field(default_factory=LookaheadConfig)
    recover: bool = True
    threads: int = 0

    def __post_init__(self) -> None:
        validate(self)


@dataclass(frozen=True, eq=False, repr=False)
class Dreamt(Result):
    """What a character did.

    Attributes:
        motion: as it was simulated, on the body's skeleton.
        asked: what the kinematic policy made, in the same frames.
        falls: s at which it lost its motion.
        back: s at which it was up again.
        tracker: the control policy.
        notes: sentences.
    """

    motion: Clip
    asked: Clip
    falls: tuple[float, ...]
    back: tuple[float, ...]
    tracker: Tracker
    notes: tuple[str, ...] = ()

    @property
    def clip(self) -> Clip:
        """The motion with standing feet held in place."""
        return hold_feet(self.motion, self.tracker.humanoid.table)[0]

    @property
    def falls_per_hour(self) -> float:
        """How often it lost its motion."""
        return 3600.0 * len(self.falls) / self.motion.seconds

    @property
    def sentence(self) -> str:
        """What became of it."""
        said = f"{self.motion.seconds:.0f} s without help"
        if not self.falls:
            return f"{said}, without a fall."
        times = "once" if len(self.falls) == 1 else f"{len(self.falls)} times"
        lying = len(self.falls) - len(self.back)
        rest = "and got up each time" if lying <= 0 else f"and did not get up {lying} times"
        return f"{said}; the character lost its motion {times}, first at {self.falls[0]:.1f} s, {rest}."

    def _shown(self) -> Shown:
        return Shown(self.clip, self.asked, None, (self.sentence, *self.notes))

    def _save_all(self, folder: Path) -> dict[str, Path]:
        paths: dict[str, Path] = {}
        for name, clip in (("simulated", self.clip), ("asked", self.asked)):
            paths[name] = folder / f"{name}{home_suffix(clip)}"
            write_clip(clip, paths[name])
        return paths


def dream(
    seconds: float,
    generator: GeneratorModel | str | Path,
    policy: Tracker | str | Path | None = None,
    config: Dream | None = None,
    *,
    progress: Show | None = None,
    **settings: Any,
) -> Dreamt:
    """Lets a character go about for some seconds, from one of the generator's pasts.

    Args:
        generator: a kinematic policy, its file or its run's folder.
        policy: the control policy; by default the one that comes with Poise.
        config: how; `settings` are those that differ.
        progress: is told what is done.

    Raises:
        PoiseError: no such generator or policy, or they are of different bodies.
    """
    config = changed(config or Dream(), settings)
    if not 0.1 <= seconds <= 36_000:
        raise PoiseError(f"a motion lasts from 0.1 s to 10 hours, got {seconds:g} s")
    tracker = policy if isinstance(policy, Tracker) else open_run(policy).tracker
    model = generator if isinstance(generator, GeneratorModel) else load_generator(generator)
    made = model.generator(tracker.humanoid, config.temperature)
    rate, steps = tracker.config.sim.control_hz, round(seconds * tracker.config.sim.control_hz)
    if model.fps != rate:
        raise PoiseError(f"the generator makes {model.fps:g} frames a second, the policy does {rate:g}")
    notes: list[str] = []
    if config.recover and tracker.recovery_clips is None:
        notes.append("The policy has not learned to get up, so it stays where it falls.")

    def goal(worlds: int, plans: bool) -> EndlessGoal:
        clips = tracker.recovery_clips if config.recover else None
        lead = max(config.lookahead.horizon, *tracker.config.window, 1) + 1
        out = EndlessGoal(
            made, tracker.humanoid, rate, clips, worlds, seed=config.seed, lead=lead, plans=plans
        )
        out.draw(torch.arange(worlds))
        return out

    # The body's own task; what it follows is the goal.
    task = imitation_of(tracker, [place(tracker.example, tracker)])
    task = replace(task, task=replace(task.task, help_by="all"))
    env, own = task.env(1, None, False, 1, help_scale=0.0), goal(1, True)
    acts: Acts = tracker.policy
    ahead = None
    if config.controller == "lookahead" and tracker.value is not None:
        acts = ahead = look_ahead(tracker, task, config.lookahead, config.threads, config.seed)
        ahead.copies.set_goal(goal(ahead.copies.num_envs, False))
        ahead.watch(env)
    seen = _Seen(own, steps, progress)
    try:
        env.backend.write(None, *own.start(None))
        env.age[:] = 0
        simulate(env, acts, env.set_goal(own), steps, seen)
    finally:
        env.close()
        if ahead is not None:
            ahead.copies.close()
    table, example = tracker.humanoid.table, tracker.example

    def clip(frames: list[Tensor], name: str) -> Clip:
        qpos = torch.stack(frames).double().numpy()
        # Joints without hinges stay as the first frame of the body's example has them.
        rot = example.rot[:1].repeat(len(qpos), 0)
        like = example.replaced(root_pos=qpos[:, :3].copy(), rot=rot, fps=rate, name=name, cyclic=False)
        return qpos_to_clip(qpos, table, example.skeleton, rate, like, name)

    times = (tuple(s / rate for _, s in x) for x in (own.falls, own.back))
    falls, back = times
    return Dreamt(
        clip(seen.qpos, "dream"), clip(seen.asked, "asked"), falls, back, tracker,
        (*notes, *own.notes),
    )  # fmt: skip


class _Seen:
    """Observes where the character is, and where it was to be."""

    def __init__(self, goal: EndlessGoal, steps: int, show: Show | None):
        self.goal, self.steps, self.show = goal, steps, show
        self.qpos, self.asked = list[Tensor](), list[Tensor]()
        self._one = torch.zeros(1, dtype=torch.long)

    def see(self, env: ImitationEnv, step: int) -> bool:
        """Keeps control step `step`."""
        self.qpos.append(env.backend.state.qpos[0].float().clone())
        self.asked.append(self.goal.coordinates(self._one, self.goal.at)[0][0].float())
        if self.show is not None:
            self.show("going about", step, self.steps)
        return False
