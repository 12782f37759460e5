"""What a term sees: the simulated and the reference character at one control step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, TypeVar

import torch
from torch import Tensor

from poise.errors import PoiseError


@dataclass(frozen=True, eq=False)
class Pose:
    """The state of N characters; float32, world frame unless said otherwise.

    qpos `(N, 7 + n)`, qvel `(N, 6 + n)` in MuJoCo's convention (root angular velocity in the root's
    frame); pos `(N, B, 3)` m, quat `(N, B, 4)` wxyz, linvel `(N, B, 3)` m/s and angvel `(N, B, 3)`
    rad/s of every body's origin; com `(N, 3)` m; local `(N, J, 4)` wxyz, each hinged joint's turn.
    heading `(N, 4)`: the root's turn about +Z.
    """

    qpos: Tensor
    qvel: Tensor
    pos: Tensor
    quat: Tensor
    linvel: Tensor
    angvel: Tensor
    com: Tensor
    local: Tensor
    heading: Tensor


class LazyPose(Pose):
    """A pose whose fields are made when a term first asks for them, and kept.

    makers: a function for every field. What is asked for must be asked for before the state that the
    functions read moves on.
    """

    def __init__(self, **makers: Callable[[], Tensor]):
        self.__dict__["_makers"] = makers

    def __getattr__(self, name: str) -> Tensor:
        makers = self.__dict__.get("_makers", {})
        if name not in makers:
            raise AttributeError(name)
        value = self.__dict__[name] = makers[name]()
        return value


class PointGoal(NamedTuple):
    """Where the reference's root is from the character's, in a task with recovery.

    far `(N,)` bool: so far away that the goal is a point. distance, before `(N,)` m: between the roots,
    now and one control step earlier.
    """

    far: Tensor
    distance: Tensor
    before: Tensor


@dataclass(frozen=True, eq=False)
class Frame:
    """Everything that a term may use; tensors only.

    sim: the character now. ref: the reference at the same time. ahead: the reference one control
    step later, where it is known. phase `(N,)` in [0, 1]: place in the clip.
    residual `(N, k)`: unscaled residual action of the last step. reg `(N,)`: its regularizer.
    min_height `(N,)` m: lowest root height of the reference clip.
    age `(N,)`: control steps since the episode began. torque `(N, n)` N m: what servos and damping
    exert on each hinge at the end of the step, where a term asks for it (`uses_torque`). point: how far
    the character is, in a task with recovery; `ahead` is a point there for those who are far. sizes
    `(N, K)`: of each character's body, see `phc_obs.shape_of`; None where all have one.
    """

    sim: Pose
    ref: Pose
    ahead: Pose | None
    phase: Tensor
    residual: Tensor
    reg: Tensor
    min_height: Tensor
    age: Tensor | None = None
    torque: Tensor | None = None
    point: PointGoal | None = None
    sizes: Tensor | None = None


TermFunction = Callable[..., Tensor]
AnyTerm = TypeVar("AnyTerm", bound=TermFunction)


def uses_torque(fn: AnyTerm) -> AnyTerm:
    """Marks a term that looks at `Frame.torque`, which is fetched for tasks with such a term alone."""
    fn.__dict__["uses_torque"] = True
    return fn


@dataclass(frozen=True)
class ObsTerm:
    """`fn(frame, **params)` gives `(N, k)` observations."""

    name: str
    fn: TermFunction
    params: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class RewardTerm:
    """`fn(frame, **params)` gives `(N,)`; the reward is the weighted sum.

    weight: above 0 for a reward, whose values lie in [0, 1]; below 0 for a cost, whose values are at
    least 0 and have a unit of their own, such as W.
    imitation: whether the term counts for the imitation reward that is reported (regularizers and costs
    do not). when: always, or in a task with recovery only near the reference or far from it; elsewhere
    it is 0. Without recovery all are near.
    """

    name: str
    fn: TermFunction
    weight: float
    params: Mapping[str, Any] = field(default_factory=dict)
    imitation: bool = True
    when: Literal["always", "near", "far"] = "always"

    def __post_init__(self) -> None:
        if self.weight < 0 and self.imitation:
            raise PoiseError(
                f"the term '{self.name}' is a cost and counts as imitation",
                hint="Give it imitation=False",
            )


@dataclass(frozen=True)
class DoneTerm:
    """`fn(frame, **params)` gives `(N,)` bool: the episode failed."""

    name: str
    fn: TermFunction
    params: Mapping[str, Any] = field(default_factory=dict)


T = TypeVar("T", ObsTerm, RewardTerm, DoneTerm)


def placed(terms: tuple[T, ...], device: torch.device) -> tuple[T, ...]:
    """The same terms with the tensors among their parameters on `device`."""

    def there(value: Any) -> Any:
        return value.to(device) if isinstance(value, Tensor) else value

    return tuple(replace(t, params={k: there(v) for k, v in t.params.items()}) for t in terms)
