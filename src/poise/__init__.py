"""Poise gives any human motion a body: a clip in, the same motion physically simulated out.

    import poise

    made = poise.imitate("walk.bvh", minutes=3)     # a policy is trained on the clip
    tracked = poise.track("kick.bvh")               # by the policy that comes with Poise
    pushed = poise.push("walk.bvh", 150.0, at="hand")  # the same, while something pushes it
    filled = poise.inbetween("dance.bvh", (0, 30, 60))
    done = poise.complete("dance.bvh", (0, 30, 60))  # the same with a body
    seen = poise.dream(60)                          # a character that goes about
    made.card, made.clip, made.notes, made.save("out")
    poise.open_run("out").evaluate(help_limit=0.0)

What is heavy is imported when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from poise.errors import PoiseError
from poise.version import __version__

if TYPE_CHECKING:
    from poise.formats import write_clip as write
    from poise.jobs.complete import complete
    from poise.jobs.endless.dreaming import dream
    from poise.jobs.endless.dreamt import Dream, Dreamt
    from poise.jobs.imitate import imitate
    from poise.jobs.inbetween.fill import inbetween
    from poise.jobs.inbetween.inbetween_settings import Inbetween
    from poise.jobs.open import Run, open_run
    from poise.jobs.push import push
    from poise.jobs.result import Result
    from poise.jobs.track import TrackConfig, track
    from poise.kinematics.rate import read_clip as read
    from poise.motion import Clip, ClipLibrary
    from poise.recipes import ResidualForce
    from poise.recipes.perpetual_settings import Perpetual

#: Where each name of the face is; it has the same name there unless another one follows.
_PLACES = {
    "Clip": "poise.motion",
    "ClipLibrary": "poise.motion",
    "Dream": "poise.jobs.endless.dreamt",
    "Dreamt": "poise.jobs.endless.dreamt",
    "Inbetween": "poise.jobs.inbetween.inbetween_settings",
    "Perpetual": "poise.recipes.perpetual",
    "ResidualForce": "poise.recipes",
    "Result": "poise.jobs.result",
    "Run": "poise.jobs.open",
    "TrackConfig": "poise.jobs.track",
    "complete": "poise.jobs.complete",
    "dream": "poise.jobs.endless.dreaming",
    "imitate": "poise.jobs.imitate",
    "inbetween": "poise.jobs.inbetween.fill",
    "open_run": "poise.jobs.open",
    "push": "poise.jobs.push",
    "read": "poise.kinematics.rate:read_clip",
    "track": "poise.jobs.track",
    "write": "poise.formats:write_clip",
}

__all__ = [
    "Clip",
    "ClipLibrary",
    "Dream",
    "Dreamt",
    "Inbetween",
    "Perpetual",
    "PoiseError",
    "ResidualForce",
    "Result",
    "Run",
    "TrackConfig",
    "__version__",
    "complete",
    "dream",
    "imitate",
    "inbetween",
    "open_run",
    "push",
    "read",
    "track",
    "write",
]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'poise' has no attribute '{name}'")
    module, _, there = _PLACES[name].partition(":")
    found = getattr(import_module(module), there or name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
