"""A tiny library with tiny networks for the perpetual recipe, and evaluations that are made up."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from poise.learn import AmpConfig, CloneConfig, ConvergenceConfig, PolicyBundle, PPOConfig
from poise.motion import Clip, ClipLibrary
from poise.papers.perpetual.ablations import StagedPerpetual
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual_settings import RecoveryPlan
from poise.score import ClipResults
from toy_human import swing

#: kind of policy, columns, largest share of the help, clip -> does it succeed?
Script = Callable[[str, int, float, int], bool]
STYLE = AmpConfig(frames=3, hidden=(8,), minibatch=16, steps=1, kept=16, replay=32)
PPO = PPOConfig(
    horizon=4, epochs=1, minibatch=64, std=0.02, policy_hidden=(16,), value_hidden=(16,), norm_warmup=2
)


def library() -> ClipLibrary:
    """A calm clip, a walk and a walk that turns."""
    clips = [
        swing(0.5, name="calm"),
        swing(0.6, speed=1.0, name="walk"),
        swing(0.8, speed=2.0, bend=1.0, name="turn"),
    ]
    return ClipLibrary.of(clips)


#: Settings of a task that tracks alone, for `tiny`.
PLAIN = {"style": None, "help_start": 0.0, "expert": False}


def lively() -> ClipLibrary:
    """A library with clips that walk and one that gets up."""
    return ClipLibrary.of([*library(), swing(1.2, speed=1.0, name="on"), rises()])


def tiny(**changes: object) -> StagedPerpetual:
    """Settings by which a stage takes a second."""
    plain = {
        "num_envs": 8,
        "single_hidden": (24, 16),
        "composer_hidden": (8,),
        "evaluate_every": 2,
        "seed": 1,
        "clone": CloneConfig(steps=4, rounds=1, critic_steps=4),
        "recovery": False,
        "recovering": RecoveryPlan(
            share=0.3,
            falls=4,
            trials=2,
            final_trials=2,
            seconds=(0.1, 0.2),
            demonstrations=4,
        ),
        "convergence": ConvergenceConfig(patience=1),
        "style": STYLE,
        "ppo": PPO,
    }
    return StagedPerpetual(**(plain | changes))  # type: ignore[arg-type]


class Scripted:
    """In place of `evaluate_clips`: outcomes by rule; remembers every evaluation it was asked for."""

    def __init__(self, script: Script):
        self.script = script
        self.asked: list[tuple[str, int, float, tuple[int, ...]]] = []

    def __call__(
        self,
        imitation: Imitation,
        policy: PolicyBundle,
        clips: Tensor | None,
        scale: float | Tensor,
        *_: object,
        starts: int = 1,
    ) -> ClipResults:
        length = imitation.reference.length
        clips = torch.arange(len(length)) if clips is None else clips
        scale = float(scale[clips].max()) if isinstance(scale, Tensor) else scale
        kind, columns = policy.shape.get("kind", "perceptron"), policy.shape.get("columns", 0)
        self.asked.append((kind, columns, scale, tuple(clips.tolist())))
        won = torch.tensor([self.script(kind, columns, scale, c) for c in clips.tolist()])
        frames = length[clips]
        error = torch.where(won, 20.0, 200.0).double()
        return ClipResults(clips, won, frames, torch.where(won, frames, frames // 2), error, error)


def rises(name: str = "rises") -> Clip:
    """A motion that lies on the back for a moment, gets up within a second, and stands."""
    clip = swing(2.4, name=name)
    up = torch.linspace(0, 2.4, clip.frames).sub(0.5).clamp(0, 1)
    lean = -math.pi / 2 * (1 - up)
    rot, pos = clip.rot.copy(), clip.root_pos.copy()
    rot[:] = rot[-1]
    rot[:, 0] = torch.stack((torch.cos(lean / 2), 0 * up, torch.sin(lean / 2), 0 * up), -1).numpy()
    pos[:, 2] *= (0.15 + 0.85 * up).numpy()
    return clip.replaced(rot=rot, root_pos=pos)
