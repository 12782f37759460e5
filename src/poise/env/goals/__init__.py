"""Goals: what characters are to do, told as it goes; clips, streams, generators, and what wraps them."""

from poise.env.goals.clip import ClipGoal
from poise.env.goals.displaced import DisplacedGoal
from poise.env.goals.endless import EndlessGoal
from poise.env.goals.generator import GeneratorGoal, MotionGenerator
from poise.env.goals.goal import Goal, extrapolated
from poise.env.goals.led import LedGoal
from poise.env.goals.stream import StreamGoal

__all__ = [
    "ClipGoal",
    "DisplacedGoal",
    "EndlessGoal",
    "GeneratorGoal",
    "Goal",
    "LedGoal",
    "MotionGenerator",
    "StreamGoal",
    "extrapolated",
]
