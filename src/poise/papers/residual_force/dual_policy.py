"""Algorithm 1 of Residual Force Control: a control policy that follows a kinematic policy without end.

Every episode begins with a past of the library (lines 6 and 7), which the kinematic policy continues by
n fresh segments, each from its own frames and with a z of its own (lines 8 to 12). The policy's state is
(x_{t-1}, x^_{t-1}, z) (line 13), its reward that of imitation with the price of the residual force.

    poise train dual-policy GENERATOR -o RUN

task = build(kinematic, humanoid, example)
trainer = task.trainer()
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

from torch import Tensor

from poise.body import Humanoid
from poise.env import ObsTerm, Reference, TaskConfig
from poise.env.events import Event
from poise.env.frame import Frame, TermFunction
from poise.env.generator_goal import GeneratorGoal
from poise.env.goal import ClipGoal, Goal
from poise.motion import Clip, ClipLibrary
from poise.recipes import residual_force
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force_settings import ResidualForce
from poise.settings import Count
from poise.sim import Backend, Drive
from poise.synthesis.generator import Kinematic


@dataclass(frozen=True)
class DualPolicy(ResidualForce):
    """Settings of the control policy; by default force that stays, as the paper's does.

    Attributes:
        segments: n, segments of the kinematic policy in an episode.
    """

    help_limit: float = 100.0
    help_start: float | None = None
    reward: Literal["world", "local"] = "local"
    done: Literal["bodies", "height", "below"] = "height"
    completion_bonus: bool = False
    expert: bool = False
    segments: Count = 5


class Latent(Event):
    """Tells terms z `(N, Z)` of the segment that each world follows."""

    def __init__(self, z: Tensor):
        self.z = z

    def tells(self) -> dict[str, Tensor]:
        return {"latent": self.z}


class KnownLatent(Latent):
    """The same of clips whose segments are known beforehand.

    Args:
        goal: follows the clips. known: `(C, K, Z)`, z of each one's segments. segment: frames of one.
    """

    def __init__(self, goal: ClipGoal, known: Tensor, segment: int):
        super().__init__(known[goal.clip, 0].clone())
        self.goal, self.known, self.segment = goal, known, segment

    def look(self, ids: Tensor | None) -> None:
        self._tell(self.goal.frame)

    def before_step(self, drive: Drive) -> bool:
        # Observations of the step are those of the next frame.
        self._tell(self.goal.frame + 1)
        return False

    def _tell(self, frame: Tensor) -> None:
        # A clip begins with the past's last frame, after which segments come.
        now = (frame // self.segment).clamp_max(self.known.shape[1] - 1)
        self.z.copy_(self.known[self.goal.clip, now])


def latent(frame: Frame) -> Tensor:
    """z `(N, Z)` of the segment that each world follows."""
    return frame.source("latent")


def of_now(fn: TermFunction, frame: Frame) -> Tensor:
    """A term of the next reference frame, of the present one: x^_{t-1} in line 13."""
    return fn(frame.replaced(ahead=frame.ref))


def dual_task(
    config: DualPolicy, humanoid: Humanoid, segment: int, z: Tensor | None = None
) -> TaskConfig:
    """The task of Algorithm 1.

    Args:
        segment: f, control steps of one.
        z: `(C, K, Z)` of the segments of clips, where those are followed; by default that of the
            generator of the worlds' goal.
    """

    def told(goal: Goal, backend: Backend) -> Event:
        if z is not None:
            return KnownLatent(goal.clips, z, segment)
        assert isinstance(goal, GeneratorGoal) and isinstance(goal.generator, Kinematic)
        assert goal.generator.latent is not None
        return Latent(goal.generator.latent)

    own = residual_force.task(config, humanoid)
    terms = [replace(t, fn=partial(of_now, t.fn)) if t.name.startswith("target") else t for t in own.obs]
    terms.append(ObsTerm("latent", latent))
    return replace(own, obs=tuple(terms), events=(told,), horizon=config.segments * segment)


def build(
    generator: Kinematic, humanoid: Humanoid, example: Clip, config: DualPolicy | None = None
) -> Imitation:
    """The task of Algorithm 1 for a kinematic policy, whose clips' skeleton `example` has; train with
    `.trainer()`."""
    config = config or DualPolicy()

    def goal(worlds: int, seed: int) -> Goal:
        made = GeneratorGoal(generator.remembering(worlds), humanoid, generator.fps, worlds, seed=seed)
        made.reset(None)
        return made

    pasts = list(generator.seeds.numpy())
    names = [f"past {k + 1}" for k in range(len(pasts))]
    reference = Reference(humanoid, pasts, generator.fps, names)
    task = dual_task(config, humanoid, generator.future)
    library = ClipLibrary.of(example)
    return Imitation(library, humanoid, reference, None, config, task, goal=goal)  # type: ignore[arg-type]
