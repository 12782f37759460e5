"""Events: what happens to worlds when episodes begin, at intervals and on conditions."""

from poise.env.events.ends import touches_of
from poise.env.events.event import Condition, Event, Happening
from poise.env.events.in_scene import InScene, MeteredPart, ScenePart
from poise.env.events.push import OnePush, Push
from poise.env.events.pushes import Pushes, Pushing
from poise.env.events.things import Move, SetDown, Switch, Throw, always, near

__all__ = [
    "Condition",
    "Event",
    "Happening",
    "InScene",
    "MeteredPart",
    "Move",
    "OnePush",
    "Push",
    "Pushes",
    "Pushing",
    "ScenePart",
    "SetDown",
    "Switch",
    "Throw",
    "always",
    "near",
    "touches_of",
]
