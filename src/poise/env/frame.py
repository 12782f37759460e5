"""What a term sees: the simulated and the reference character at one control step, by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, NamedTuple, TypeVar

import torch
from torch import Tensor

from poise.errors import PoiseError, did_you_mean


@dataclass(frozen=True, eq=False)
class Pose:
    """The state of N characters; float32, world frame unless said otherwise.

    qpos `(N, 7 + n)`, qvel `(N, 6 + n)` in MuJoCo's convention (root angular velocity in the root's
    frame); pos `(N, B, 3)` m, quat `(N, B, 4)` wxyz, linvel `(N, B, 3)` m/s and angvel `(N, B, 3)`
    rad/s of every body's origin; com `(N, 3)` m; local `(N, J, 4)` wxyz, each hinged joint's turn.
    heading `(N, 4)`: the root's turn about +Z: its twist; in frames and poses of an environment by what
    `TaskConfig.left` says.
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


#: The fields of a pose in the order in which they are packed.
FIELDS = tuple(f.name for f in fields(Pose))


class Place(NamedTuple):
    """What a packed pose says of its clip, float32 `(N)` each.

    Attributes:
        phase: place in the clip, 0 to 1.
        low: the clip's lowest root height, m.
        end: 1 on the last frame of a clip that does not go on, else 0.
        body: which of the goal's bodies the clip is for.
    """

    phase: Tensor
    low: Tensor
    end: Tensor
    body: Tensor


class Layout:
    """Where the numbers of a pose and of its place stand in a row of packed poses `(N, W)`."""

    def __init__(self, pose: Pose):
        self._shapes = tuple(getattr(pose, name).shape[1:] for name in FIELDS)
        self._widths = [*(math.prod(shape) for shape in self._shapes), len(Place._fields)]

    @property
    def width(self) -> int:
        """W, the numbers of a row."""
        return sum(self._widths)

    def pack(self, pose: Pose, place: Tensor) -> Tensor:
        """Poses and their places `(N, 4)` as rows `(N, W)`."""
        return torch.cat((packed_pose(pose), place), 1)

    def unpacked(self, packed: Tensor) -> Pose:
        """The poses in the rows of `packed (N, W)`, as views of it."""
        parts = packed.split_with_sizes(self._widths, -1)[: len(FIELDS)]
        shaped: list[Tensor] = [
            part if len(shape) == 1 else part.unflatten(-1, shape)
            for part, shape in zip(parts, self._shapes, strict=True)
        ]
        return Pose(*shaped)

    def place(self, packed: Tensor) -> Place:
        """What the rows of `packed (N, W)` say of their clips, as views of it."""
        return Place(*packed[:, -len(Place._fields) :].unbind(-1))


def packed_pose(pose: Pose) -> Tensor:
    """The numbers of poses, without their places."""
    return torch.cat([getattr(pose, name).flatten(1) for name in FIELDS], 1)


class LazyPose(Pose):
    """A pose with fields that are made when a term first asks for them, and kept.

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


class Frame:
    """Everything that a term may use, looked up by name when a term first asks for it, and kept.

    A name is that of an observable: a function of the frame in `env.observables`, in a plug-in, or in
    `TaskConfig.observables`. An observable reads tensors through `source`, or other observables.

    The observables that every task has:
        sim: the character now.
        ref: the reference at the same time.
        ahead: the reference one control step later, None where it is not known.
        window: the reference at the steps of `TaskConfig.window`; fields are `(N, K, ...)`.
        phase: `(N,)` in [0, 1], place in the clip.
        action, action_before: `(N, n)` hinges' actions of the last step, as they acted, and of the one
            before it, 0 at first.
        residual: `(N, k)` unscaled residual action of the last step.
        reg: `(N,)` the regularizer of the residual.
        min_height: `(N,)` m, lowest root height of the reference clip.
        age: `(N,)` control steps since the episode began.
        torque, torque_before: `(N, n)` N m that servos and damping exert on each hinge at the end of the
            step, and at its begin.
        linvel_before: `(N, B, 3)` m/s, velocities of the bodies less the reference's at its begin.
        point: where the reference's root is, in a task with recovery; else None.
        sizes: `(N, K)` of each character's body, see `phc_obs.shape_of`; None where all have one.
    """

    sim: Pose
    ref: Pose
    ahead: Pose | None
    window: Pose
    phase: Tensor
    action: Tensor
    action_before: Tensor
    residual: Tensor
    reg: Tensor
    min_height: Tensor
    age: Tensor | None
    torque: Tensor | None
    torque_before: Tensor | None
    linvel_before: Tensor
    point: PointGoal | None
    sizes: Tensor | None
    #: What frames of one environment share, see `env.observables.Context`.
    context: Any

    def __init__(
        self, sources: Mapping[str, Tensor], observables: Mapping[str, Observable], context: Any = None
    ):
        self.__dict__.update(_sources=sources, _observables=observables, context=context)

    @classmethod
    def given(cls, **values: Any) -> Frame:
        """A frame with the observables `values`; others that are asked for are None."""
        frame = cls({}, _Unknown())
        frame.__dict__.update(values)
        return frame

    def replaced(self, **values: Any) -> Frame:
        """The same frame with other values of some observables."""
        other = Frame(self._sources, self._observables, self.context)
        other.__dict__.update(self.__dict__ | values)
        return other

    def source(self, name: str) -> Tensor:
        """A tensor by its name: a field of MuJoCo's state such as "qfrc_constraint" `(N, ...)`, the
        "action" `(N, A)`, the "age" `(N,)`, or a column of a plug-in."""
        return self._sources[name]

    def __getattr__(self, name: str) -> Any:
        observables: Mapping[str, Observable] = self.__dict__.get("_observables", {})
        if name not in observables:
            known = did_you_mean(name, sorted(observables))
            raise AttributeError(f"a frame has no observable '{name}'. {known}")
        value = self.__dict__[name] = observables[name](self)
        return value


#: A function of a frame; the frame keeps its value.
Observable = Callable[[Frame], Any]


class _Unknown(dict[str, Observable]):
    """Observables of which every one is None."""

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and not name.startswith("__")

    def __getitem__(self, name: str) -> Observable:
        return lambda frame: None


TermFunction = Callable[..., Tensor]


@dataclass(frozen=True)
class ObsTerm:
    """`fn(frame, **params)` gives `(N, k)` observations."""

    name: str
    fn: TermFunction
    params: Mapping[str, Any] = field(default_factory=dict[str, Any])


@dataclass(frozen=True)
class RewardTerm:
    """`fn(frame, **params)` gives `(N,)`; the reward is the weighted sum.

    Attributes:
        weight: above 0 for a reward, with values in [0, 1]; below 0 for a cost, with values of at least
            0 and a unit of their own, such as W.
        imitation: whether the term counts for the imitation reward that is reported (regularizers and
            costs do not).
        when: always, or in a task with recovery only near the reference or far from it; elsewhere it is
            0. Without recovery all are near.
    """

    name: str
    fn: TermFunction
    weight: float
    params: Mapping[str, Any] = field(default_factory=dict[str, Any])
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
    params: Mapping[str, Any] = field(default_factory=dict[str, Any])


T = TypeVar("T", ObsTerm, RewardTerm, DoneTerm)


def placed(terms: tuple[T, ...], device: torch.device) -> tuple[T, ...]:
    """The same terms with the tensors among their parameters on `device`."""

    def there(value: Any) -> Any:
        return value.to(device) if isinstance(value, Tensor) else value

    return tuple(replace(t, params={k: there(v) for k, v in t.params.items()}) for t in terms)
