"""How a motion is tracked: by which controller, how many characters, on what."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Literal

from poise.errors import PoiseError
from poise.settings import Range, part, validate

if TYPE_CHECKING:
    from poise.jobs.track.direction import Direction
    from poise.jobs.track.pushed import PushConfig
    from poise.jobs.track.simulation import Retake
    from poise.kinematics.supports import Support
    from poise.motion.noise import Noise
    from poise.plan import LookaheadConfig, SamplingConfig

#: Characters in one world.
MOST = 64
#: Which controller does a motion.
Controller = Literal["auto", "policy", "lookahead", "search"]
#: The body that a motion is done on.
BodyChoice = Literal["policy", "own"]
#: What becomes of a clip in place.
Mode = Literal["auto", "keep", "travel"]


@dataclass(frozen=True)
class TrackConfig:
    """How a motion is tracked.

    Attributes:
        noise: errors of a pose estimator on the input, see `motion.noise`.
        seed: seed of the noise, and of what lookahead and search draw.
        reset_on_fail: put a character that is 0.5 m off back onto the motion, and go on.
        recover: a character that is 0.5 m off gets up, walks back and goes on where the motion waits for
            it, see `env.recovery`.
        smooth_hz: cut-off of a low-pass on keypoints.
        count: characters that do the motion side by side in one world, where they may collide.
        controller: policy acts alone, at once; lookahead tries in copies of the character before it
            acts, which is nearer to the motion and cleaner; search lets many characters try the whole
            motion at once. auto looks ahead, and searches what is lost so.
        lookahead: how it looks ahead; its seed is `seed`.
        search: how it searches; its seed is `seed`.
        threads: cores for lookahead and search; 0 is all.
        body: policy is the body that it was trained on, onto which the motion is retargeted; own has the
            same joints with the lengths and masses of the skeleton that came in.
        supports: "auto" puts boxes where a single motion sits, leans or steps on something
            (`kinematics.supports`), "none" leaves the floor alone; or supports beside the motion that
            comes in.
        direction: parts that count more, stay put or are touched.
        retake: a part that is simulated anew, while the rest stays as an earlier result has it.
        push: a push in it, to which the character gives way.
        in_place: a clip that walks in place is simulated with the travel that its feet tell. auto writes
            it in place again, a loop as a loop; travel writes it with its travel; keep simulates it as
            it is.
    """

    noise: tuple[Noise, ...] = field(default=(), metadata={"place": "poise.motion.noise:Noise"})
    seed: int = 0
    reset_on_fail: bool = False
    recover: bool = False
    smooth_hz: float | None = None
    count: Annotated[int, Range(1, MOST, unit="characters")] = 1
    controller: Controller = "auto"
    lookahead: LookaheadConfig = part("poise.plan:LookaheadConfig")
    search: SamplingConfig = part("poise.plan:SamplingConfig")
    threads: Annotated[int, Range(0)] = 0
    body: BodyChoice = "policy"
    supports: Literal["auto", "none"] | tuple[Support, ...] = field(
        default="auto", metadata={"place": "poise.kinematics.supports:Support"}
    )
    direction: Direction = part("poise.jobs.track.direction:Direction")
    retake: Retake | None = part("poise.jobs.track.simulation:Retake", made=False)
    push: PushConfig | None = part("poise.jobs.track.pushed:PushConfig", made=False)
    in_place: Mode = "auto"

    def __post_init__(self) -> None:
        validate(self)
        for rule in RULES:
            other = next((r for r in RULES if r.name in rule.alone and r.asked(self)), None)
            if other is not None and rule.asked(self):
                raise PoiseError(
                    f"{rule.subject} for a single character that tracks, not {other.called}",
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
        if not clips:
            raise PoiseError("there is no clip to track", code="no-clips")
        rule = next((r for r in RULES if r.single and r.asked(self)), None)
        if clips > 1 and rule is not None:
            raise PoiseError(
                f"{rule.subject} for a single clip, and {clips} were given", code="single-clip-only"
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


@dataclass(frozen=True)
class Rule:
    """What a feature of tracking is not combined with.

    Attributes:
        name: of the feature.
        asked: whether settings ask for it.
        subject: what begins a sentence about it: "a push is".
        called: what ends a sentence of another one: "a motion with noise".
        alone: features that it is not combined with.
        single: whether it is for a single clip.
    """

    name: str
    asked: Callable[[TrackConfig], bool]
    subject: str
    called: str
    alone: tuple[str, ...] = ()
    single: bool = True


_OTHERS = ("recover", "reset", "count")
#: What cannot be combined, each feature once; the first that meets another one is told.
RULES = (
    Rule("count", lambda c: c.count > 1, "several characters are", "several characters"),
    Rule("noise", lambda c: bool(c.noise), "noise is", "a motion with noise"),
    Rule(
        "reset",
        lambda c: c.reset_on_fail,
        "putting a character back is",
        "one that is put back onto the motion",
    ),
    Rule(
        "recover",
        lambda c: c.recover,
        "coming back is",
        "one that comes back by itself",
        ("count", "reset"),
        single=False,
    ),
    Rule(
        "search",
        lambda c: c.controller == "search",
        "a search is",
        "a search, which looks for the whole motion",
        _OTHERS,
    ),
    Rule("body", lambda c: c.body == "own", "a body of its own is", "a body of its own"),
    Rule(
        "direction",
        lambda c: bool(c.direction),
        "weights, pins and touches are",
        "one that is directed",
        ("recover", "count"),
    ),
    Rule(
        "retake",
        lambda c: c.retake is not None,
        "a range is",
        "a part that is simulated anew",
        (*_OTHERS, "noise", "search"),
    ),
    Rule(
        "push",
        lambda c: c.push is not None,
        "a push is",
        "one that is pushed",
        (*_OTHERS, "noise", "retake", "search"),
    ),
    Rule(
        "supports",
        lambda c: isinstance(c.supports, tuple),
        "a support is",
        "one with supports",
        ("recover", "count"),
    ),
)
