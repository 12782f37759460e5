"""How a motion is tracked: by which controller, how many characters, on what."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from poise.errors import PoiseError
from poise.jobs.track.direction import Direction
from poise.jobs.track.pushed import PushConfig
from poise.jobs.track.simulation import Retake
from poise.kinematics.supports import Support
from poise.motion.noise import Noise
from poise.plan import LookaheadConfig, SamplingConfig
from poise.settings import Range, validate

#: Characters in one world.
MOST = 64
#: Which controller does a motion.
Controller = Literal["auto", "policy", "lookahead", "search"]


@dataclass(frozen=True)
class TrackConfig:
    """How a motion is tracked.

    Attributes:
        noise, seed: what is done to the input first, see `motion.noise`.
        reset_on_fail: a character that failed is put back onto the reference.
        recover: it gets up, comes back and goes on, while the motion waits, see `env.recovery`; for one
            character.
        smooth_hz: cut-off of a low-pass on keypoints.
        count: characters that do the motion side by side in one world, see `track.crowd`.
        controller: "policy" acts alone, "lookahead" simulates what it may do before it acts
            (`plan.lookahead`), "search" looks for the whole motion (`plan.sampling`), for one character;
            "auto" looks ahead, and searches what is lost so, but for `recover` and several clips.
        lookahead: how it looks ahead; its seed is `seed`.
        search: how it searches; its seed is `seed`.
        threads: cores of lookahead and search, 0 is all of them.
        body: "policy" is the one that it was trained on, onto which motions are retargeted; "own" has
            the same bodies and hinges with the lengths and masses of the skeleton that came in.
        supports: "auto" puts boxes where a single motion sits, leans or steps on something
            (`kin.supports`), "none" leaves the floor alone; or supports beside the motion that comes in.
        direction: what counts more, stays put or is touched; for a single clip.
        retake: a part that is simulated anew, while the rest stays as an earlier result has it; for a
            single clip.
        push: a push in it, to which the character gives way; for one character and a single clip, which
            no search looks for.
        in_place: what becomes of a clip in place, see `track.in_place`.
    """

    noise: tuple[Noise, ...] = ()
    seed: int = 0
    reset_on_fail: bool = False
    recover: bool = False
    smooth_hz: float | None = None
    count: Annotated[int, Range(1, MOST, unit="characters")] = 1
    controller: Controller = "auto"
    lookahead: LookaheadConfig = field(default_factory=LookaheadConfig)
    search: SamplingConfig = field(default_factory=SamplingConfig)
    threads: int = 0
    body: Literal["policy", "own"] = "policy"
    supports: Literal["auto", "none"] | tuple[Support, ...] = "auto"
    direction: Direction = field(default_factory=Direction)
    retake: Retake | None = None
    push: PushConfig | None = None
    in_place: Mode = "auto"

    def __post_init__(self) -> None:
        validate(self)
        if self.recover and (self.reset_on_fail or self.count > 1):
            what = "several characters" if self.count > 1 else "one that is put back onto the motion"
            raise PoiseError(
                f"only a single character comes back by itself, not {what}", code="single-character-only"
            )
        if self.controller == "search" and (self.recover or self.reset_on_fail or self.count > 1):
            what = "several characters" if self.count > 1 else "one that comes or is put back"
            raise PoiseError(
                f"a motion is searched for a single character, not {what}", code="single-character-only"
            )

        if isinstance(self.supports, tuple) and (self.recover or self.count > 1):
            what = "several characters" if self.count > 1 else "one that comes back by itself"
            raise PoiseError(
                f"supports are for a single character, not {what}", code="single-character-only"
            )
        if self.direction and (self.recover or self.count > 1):
            what = "several characters" if self.count > 1 else "one that comes back by itself"
            raise PoiseError(
                f"weights, pins and touches are for a single character, not {what}",
                code="single-character-only",
            )
        if self.retake is not None:
            others = {
                "one that comes or is put back": self.recover or self.reset_on_fail,
                "several characters": self.count > 1,
                "a motion with noise": bool(self.noise),
                "a search, which looks for the whole motion": self.controller == "search",
            }
            if any(others.values()):
                what = next(name for name, asked in others.items() if asked)
                raise PoiseError(
                    f"a range is for a single character that tracks, not {what}",
                    code="single-character-only",
                )
        if self.push is not None:
            others = {
                "one that comes or is put back": self.recover or self.reset_on_fail,
                "several characters": self.count > 1,
                "a motion with noise": bool(self.noise),
                "a part that is simulated anew": self.retake is not None,
                "a search, which would know of it": self.controller == "search",
            }
            if any(others.values()):
                what = next(name for name, asked in others.items() if asked)
                raise PoiseError(
                    f"a push is for a single character that tracks, not {what}",
                    code="single-character-only",
                )
        if self.body == "own" and self.recover:
            raise PoiseError(
                "recovery clips are those of the policy's body, so body='own' has none",
                code="settings-conflict",
            )

    def check(self, clips: int) -> None:
        """Refuses what cannot be done with so many clips one after another.

        Raises:
            PoiseError: no clips, or several with what is for a single one.
        """
        alone = {
            "several characters are": self.count > 1, "noise is": bool(self.noise),
            "putting a character back is": self.reset_on_fail,
            "a search is": self.controller == "search", "a body of its own is": self.body == "own",
            "weights, pins and touches are": bool(self.direction),
            "a range is": self.retake is not None,
            "a push is": self.push is not None,
            "a support is": isinstance(self.supports, tuple),
        }  # fmt: skip
        if not clips:
            raise PoiseError("there is no clip to track", code="no-clips")
        if clips > 1 and any(alone.values()):
            what = next(name for name, asked in alone.items() if asked)
            raise PoiseError(
                f"{what} for a single clip, and {clips} were given", code="single-clip-only"
            )

    @property
    def looks_ahead(self) -> bool:
        """Whether lookahead is wanted."""
        return self.controller in ("auto", "lookahead")

    @property
    def searches(self) -> bool:
        """Whether what is lost is searched."""
        single = not (self.recover or self.reset_on_fail or self.count > 1 or self.push)
        return self.controller == "search" or (self.controller == "auto" and single)


#: What becomes of a clip in place: "keep" simulates it as it is, "travel" writes it
#: with its travel, "auto" writes it in place again.
Mode = Literal["auto", "keep", "travel"]
