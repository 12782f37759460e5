"""Settings refuse what their fields cannot be, when they are made."""

from __future__ import annotations

import importlib
import math
import pkgutil
import re
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_type_hints

import numpy as np
import pytest
import torch

import poise
from poise.control import Compliance, LinearHelp, PDTargets, Stiffness
from poise.env import TaskConfig
from poise.env.generator_goal import Footprint, Steering
from poise.env.pushes import HeldThing, Push, Pushes
from poise.env.recovery.clock import Recovery
from poise.env.recovery.seats import Seat
from poise.env.scene_events import Throw
from poise.env.walk_path import WalkPath
from poise.errors import PoiseError
from poise.jobs.endless.dream_world import DreamPush
from poise.jobs.inbetween.inbetween_settings import Inbetween
from poise.jobs.track.direction import FrameStiffness, Weight
from poise.jobs.track.pushed import HeldConfig
from poise.learn import PPOConfig, Until
from poise.motion.noise import Drift
from poise.papers.compliant.scenes import Balance, DoorScene, TrampolineScene
from poise.plan import TeacherConfig
from poise.recipes import ResidualForce
from poise.recipes.perpetual_settings import Perpetual, RecoveryPlan
from poise.settings import Checked, Count, Length, Positive, Range, Share, validate
from poise.sim.floor import HeightField
from poise.sim.props import Box, Door, Mesh
from poise.sim.scene import Scene
from refusals import refused

#: One of each class that cannot be made without arguments, or has no numbers by default.
EXAMPLES: dict[type, Any] = {
    Balance: Balance(lengths=(1.0, 1.0), masses=(1.0, 1.0)),
    Compliance: Compliance(joints=(("thigh", 1.0),), drawn=(0.0, 0.1)),
    DoorScene: DoorScene(widths=(1.0, 1.0)),
    DreamPush: DreamPush(every_s=(1.0, 2.0)),
    FrameStiffness: FrameStiffness(0, 100.0),
    HeldConfig: HeldConfig("left_hand", 1.0),
    HeldThing: HeldThing(0, 1.0, 0.2, 0, 1),
    HeightField: HeightField(np.zeros((2, 2)), (1.0, 1.0)),
    LinearHelp: LinearHelp(0, 9),
    Mesh: Mesh(Path(__file__)),
    Perpetual: Perpetual(window=(2,), noise=(1.0,)),
    PPOConfig: PPOConfig(smooth_over=(0, 1)),
    Push: Push(0, (0.0, 0.0, 1.0), 0, 1),
    Scene: Scene(()),
    Seat: Seat(Footprint((1.0, 1.0), (1.0, 1.0)), 0.4),
    Steering: Steering(((1.0, 1.0),)),
    Stiffness: Stiffness(schedule=((1, 100.0),)),
    TaskConfig: TaskConfig((), (), (), PDTargets()),
    Throw: Throw("ball", "somebody"),
    TrampolineScene: TrampolineScene(heights=(0.1, 0.1)),
    Until: Until(iterations=1),
    WalkPath: WalkPath(((0.0, 0.0), (1.0, 1.0)), 1.0),
    Weight: Weight("hands", 1.0),
}


def classes() -> list[type]:
    """Every dataclass of the package that declares the range or the length of a field."""
    found: dict[type, None] = {}
    for module in pkgutil.walk_packages(poise.__path__, "poise."):
        if module.name.startswith(("poise.cli", "poise.__main__")):
            continue
        try:
            members = vars(importlib.import_module(module.name))
        except ImportError:
            continue  # A package that is not installed.
        for kind in members.values():
            own = isinstance(kind, type) and kind.__module__ == module.name and is_dataclass(kind)
            if own and any(marks_of(h) for h in hints_of(kind).values()):
                found[kind] = None
    return list(found)


def hints_of(kind: type) -> dict[str, Any]:
    try:
        return get_type_hints(kind, include_extras=True)
    except NameError:
        # It names what is imported for types alone, and so declares no range.
        return {}


def marks_of(hint: Any) -> list[Any]:
    own = [m for m in getattr(hint, "__metadata__", ()) if isinstance(m, Range | Length)]
    return own + [m for a in get_args(hint) for m in marks_of(a)]


def made(kind: type) -> Any:
    if kind not in EXAMPLES:
        lacking = [f.name for f in fields(kind) if f.default is f.default_factory is MISSING]
        assert not lacking, f"{kind.__name__} needs an example, for {lacking}"
        EXAMPLES[kind] = kind()
    return EXAMPLES[kind]


def like(was: Any, number: float) -> Any:
    """`number` as a value of a field that was `was`."""
    if isinstance(was, tuple):
        return tuple(v if isinstance(v, str) else like(v, number) for v in was)
    return number


def values(limits: Range, hint: Any) -> Iterator[tuple[float, bool]]:
    """Numbers at and beside the limits, and whether a field of such a range may have them."""
    whole = "int" in str(hint) and "float" not in str(hint)
    for limit, excluded, away in ((limits.low, limits.above, -1), (limits.high, limits.below, 1)):
        if math.isinf(limit):
            if not whole:
                yield limit, limits.infinite and limit > 0
            continue
        step = 1 if whole else 1e-6 * max(1.0, abs(limit))
        yield limit, not excluded
        yield limit + away * step, False
        yield limit - away * step, True
    if not whole:
        yield math.nan, False


def refuses(config: Any, name: str, value: Any, mark: Range | Length) -> bool:
    """Whether a field may not have a value since it lies outside of `mark`."""
    try:
        replace(config, **{name: value})
    except PoiseError as problem:
        return any(f": {name} must {rises}{mark}" in str(problem) for rises in ("", "rise and "))
    return False


def test_every_declared_range_is_kept() -> None:
    kinds = classes()
    assert len(kinds) > 40
    for kind in kinds:
        config = made(kind)
        for name, hint in hints_of(kind).items():
            was = getattr(config, name, None)
            for mark in marks_of(hint):
                if isinstance(mark, Length):
                    assert mark.low == 0 or refuses(config, name, (), mark), (kind, name)
                    continue
                for number, right in values(mark, hint):
                    said = refuses(config, name, like(was, number), mark)
                    assert said != right, (kind.__name__, name, number, said)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ResidualForce(method="ppo"), ("unknown-choice", ("method", "rfc-implicit"))),
        (lambda: ResidualForce(reward="wrld"), ("unknown-choice", "world")),
        (lambda: ResidualForce(help_schedule="linea"), ("unknown-choice", "linear")),
        (lambda: ResidualForce(seed=-1), ("out-of-range", "seed")),
        (lambda: ResidualForce(seed=2**70), ("out-of-range", "seed")),
        (lambda: Perpetual(goal="rotation"), ("unknown-choice", "rotations")),
        (lambda: Perpetual(help_by="moment"), ("unknown-choice", ("help_by", "moment"))),
        (lambda: RecoveryPlan(primitive="last"), ("unknown-choice", ("primitive", "last"))),
        (lambda: Inbetween(net="gru"), ("unknown-choice", "transformer, rtn")),
        (lambda: Recovery(switch=6.0), ("not-rising", "switch")),
        (lambda: PPOConfig(products="half"), ("unknown-choice", ("products", "half"))),
    ],
)
def test_another_value_is_refused(make, words: tuple) -> None:
    with refused(*words):
        make()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: PPOConfig(policy_lr=0.0), r"^PPOConfig: policy_lr must be above 0, got 0\.0$"),
        (lambda: PPOConfig(gamma=1.01), r"^PPOConfig: gamma must lie in 0 to 1, got 1\.01$"),
        (
            lambda: PPOConfig(lr_range=(1e-3, 1e-5)),
            r"lr_range must rise and be above 0, got \(0\.001, 1e-05",
        ),
        (lambda: PPOConfig(entropy_weight=math.nan), r"entropy_weight must be a finite number, got nan"),
        (lambda: PPOConfig(lr_range=(1e-5,)), r"lr_range must have 2 values, got \(1e-05,\)"),
        (lambda: PPOConfig(clip="wide"), r"clip must be above 0, got 'wide'"),
        (lambda: Pushes(bodies=()), r"bodies must have at least 1 value, got \(\)"),
        (lambda: Pushes(newtons=(50.0, 20.0)), r"newtons must rise and be at least 0 N"),
        (lambda: Pushes(lasts_s=0.0), r"lasts_s must be above 0 s, got 0\.0"),
        (lambda: Push(0, (0.0, math.nan, 0.0), 0, 1), r"force must be a finite number in each value"),
        (lambda: Door("gate", width=0.0), r"^Door 'gate': width must be above 0, got 0\.0"),
        (lambda: Box(mass=-1.0), r"^Box 'box': mass must be at least 0"),
        (lambda: Compliance(joints=(("thigh", 2.0),)), r"joints must lie in 0 to 1 in each value"),
        (lambda: Drift(sigma_m=(0.1, -0.1, 0.1)), r"sigma_m must be at least 0 in each value"),
        (lambda: TeacherConfig(discount=0.0), r"discount must be above 0 and at most 1, got 0\.0"),
        (lambda: Weight("hands", -1.0), r"^hands: factor must lie in 0 to"),
    ],
)
def test_a_value_out_of_range_is_named_with_its_limits(make, words: str) -> None:
    with refused("out-of-range") as caught:
        make()
    assert re.search(words, str(caught.value))


def test_what_is_not_limited_stays_free() -> None:
    assert math.isinf(Pushes(impulse_ns=math.inf).impulse_ns)
    assert math.isinf(Recovery(switch=math.inf).switch)
    assert Until(minutes=math.inf).samples is None
    assert PPOConfig(kl_stop=None, smooth_over=None).kl_stop is None
    scale = torch.tensor([1.0, math.inf])
    assert PDTargets(scale=scale).scale is scale


@dataclass(frozen=True)
class Kinds(Checked):
    share: Share = 0.5
    count: Count | None = None
    pair: Annotated[float | tuple[float, float], Range(0, 2, rising=True, unit="m")] = 1.0
    named: Annotated[tuple[tuple[str, float], ...], Range(0, above=True), Length(0, 2)] = ()
    word: Literal["a", "b"] | float = "a"
    turned: Annotated[int, Range(-1, hint="Turn it back")] = 0
    most: Annotated[Positive | None, "a note of another kind"] = None


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"share": np.float32(2.0)}, r"^Kinds: share must lie in 0 to 1, got 2\.0$"),
        ({"share": torch.tensor(math.nan)}, "share must lie in 0 to 1, got nan"),
        ({"share": None}, "share must lie in 0 to 1, got None"),
        ({"count": 0}, "count must be at least 1, got 0"),
        ({"pair": 3.0}, "pair must lie in 0 to 2 m, got 3.0"),
        ({"pair": (1.0, 0.5)}, r"pair must rise and lie in 0 to 2 m, got \(1\.0, 0\.5\)"),
        ({"pair": (0.0, 1.0, 2.0)}, "pair must have 2 values"),
        ({"pair": np.array([0.0, 3.0])}, "pair must"),
        ({"named": (("x", 0.0),)}, "named must be above 0 in each value"),
        ({"named": (("x", 1.0),) * 3}, "named must have at most 2 values"),
        ({"word": math.inf}, "word must be a finite number"),
        ({"turned": -2}, r"turned must be at least -1, got -2\. Turn it back"),
        ({"most": 0.0}, "most must be above 0, got 0.0"),
    ],
)
def test_fields_of_every_kind(given: dict[str, Any], words: str) -> None:
    with pytest.raises(PoiseError) as caught:
        Kinds(**given)
    assert re.search(words, str(caught.value))


def test_fields_of_every_kind_hold_what_is_right() -> None:
    Kinds(np.float32(1.0), None, (0.0, 0.0), (("x", 1.0), ("y", 2.0)), 3.0, -1, 1e-9)
    Kinds(torch.tensor(0.0), np.int64(3), np.array([0.0, 2.0]), word="b")


def test_the_object_may_be_called_otherwise() -> None:
    @dataclass(frozen=True)
    class Made:
        size: float = 1.0

        def __post_init__(self) -> None:
            validate(self, "the thing")

    with refused("out-of-range", says=("the thing", "size", "inf")):
        Made(math.inf)
