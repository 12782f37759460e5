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

from typing import TYPE_CHECKING

from poise.errors import PoiseError
from poise.lazy import lazy
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


__getattr__ = lazy(
    __name__,
    {
        "formats": "write=write_clip",
        "jobs.complete": "complete",
        "jobs.endless.dreaming": "dream",
        "jobs.endless.dreamt": "Dream Dreamt",
        "jobs.imitate": "imitate",
        "jobs.inbetween.fill": "inbetween",
        "jobs.inbetween.inbetween_settings": "Inbetween",
        "jobs.open": "Run open_run",
        "jobs.push": "push",
        "jobs.result": "Result",
        "jobs.track": "TrackConfig track",
        "kinematics.rate": "read=read_clip",
        "motion": "Clip ClipLibrary",
        "recipes.residual_force_settings": "ResidualForce",
        "recipes.perpetual_settings": "Perpetual",
    },
)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
