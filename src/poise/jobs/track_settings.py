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
            it.
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
        direction: parts that count more, stay put or are touched; pushes, and things in hands.
        retake: a part that is simulated anew, while the rest stays as an earlier result has it.
        push: a push in it, to which the character gives way.
        help_limit: N, and N m, that a hand which leads the root may give at most, by inverse dynamics
            and a spring; 0 for none. No real person has such help: notes and score card state it.
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
    help_limit: Annotated[float, Range(0, unit="N")] = 0.0
    in_place: Mode = "auto"

    def __post_init__(self) -> None:
        validate(self)
        for name in self._asked:
            other = next((n for n in RULES[name][1] if n in self._asked), None)
            if other is not None:
                raise PoiseError(
                    f"{name} is for a single character that tracks, and cannot go with {other}",
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
        alone = [name for name in self._asked if name != _COMES]
        if clips > 1 and alone:
            raise PoiseError(
                f"only a single clip can have {alone[0]}, and {clips} were given",
                code="single-clip-only",
            )

    @property
    def _asked(self) -> list[str]:
        return [name for name, (asked, _) in RULES.items() if asked(self)]

    @property
    def forced(self) -> bool:
        """Whether something pushes, or is held."""
        return self.push is not None or self.direction.forces

    @property
    def looks_ahead(self) -> bool:
        """Whether lookahead is wanted."""
        return self.controller in ("auto", "lookahead")

    @property
    def searches(self) -> bool:
        """Whether what is lost is searched."""
        single = not (self.recover or self.reset_on_fail or self.count > 1 or self.forced)
        return self.controller == "search" or (self.controller == "auto" and single)


#: Features by their names, where each is asked for, and the ones that it is not combined with; all but
#: coming back are for a single clip.
_BACK, _COMES, _MANY = "putting a character back", "coming back by itself", "several characters"
RULES: dict[str, tuple[Callable[[TrackConfig], bool], tuple[str, ...]]] = {
    _MANY: (lambda c: c.count > 1, ()),
    "noise": (lambda c: bool(c.noise), ()),
    _BACK: (lambda c: c.reset_on_fail, ()),
    _COMES: (lambda c: c.recover, (_MANY, _BACK)),
    "a search": (lambda c: c.controller == "search", (_COMES, _BACK, _MANY)),
    "a body of its own": (lambda c: c.body == "own", ()),
    "weights, pins and touches": (lambda c: c.direction.leads, (_COMES, _MANY)),
    "a range": (lambda c: c.retake is not None, (_COMES, _BACK, _MANY, "noise", "a search")),
    "a push": (
        lambda c: c.push is not None or bool(c.direction.pushes),
        (_COMES, _BACK, _MANY, "noise", "a range", "a search"),
    ),
    "a held thing": (
        lambda c: bool(c.direction.held),
        (_COMES, _BACK, _MANY, "noise", "a range", "a search"),
    ),
    "help": (lambda c: c.help_limit > 0, (_COMES, _BACK, _MANY, "a range", "a push", "a held thing")),
    "a support": (lambda c: isinstance(c.supports, tuple), (_COMES, _MANY)),
}
