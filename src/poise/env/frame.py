"""The view of a term: the simulated and the reference character at one control step, by name."""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from types import FunctionType
from typing import Any, Literal, NamedTuple, TypeVar

import torch
from torch import Tensor

from poise.control import Residual
from poise.errors import PoiseError, did_you_mean
from poise.motion.rotations import heading_quat, lateral_heading


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


class PosePlace(NamedTuple):
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


class PoseLayout:
    """Where the numbers of a pose and of its place stand in a row of packed poses `(N, W)`."""

    def __init__(self, pose: Pose):
        self._shapes = tuple(getattr(pose, name).shape[1:] for name in FIELDS)
        self._widths = [*(math.prod(shape) for shape in self._shapes), len(PosePlace._fields)]

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

    def place(self, packed: Tensor) -> PosePlace:
        """What the rows of `packed (N, W)` say of their clips, as views of it."""
        return PosePlace(*packed[:, -len(PosePlace._fields) :].unbind(-1))


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

    A name is that of an observable: a function of the frame in `env.frame`, in an event, or in
    `TaskConfig.observables`. An observable reads tensors through `source`, or other observables. A new
    one is one more function, for which every term can ask by its name:

        def contact_torque(frame: Frame) -> Tensor:
            # `(N, n)` N m that contacts and limits exert on each hinge.
            return frame.source("qfrc_constraint")[:, 6:].float()

    Only tasks with a term that asks for a `source` fetch that field of MuJoCo's state.

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
        spared: `(N,)` bool, episodes that cannot end in this step; None: none is spared.
        sizes: `(N, K)` of each character's body, see `observations.shape_of`; None where all have one.
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
    spared: Tensor | None
    sizes: Tensor | None
    #: What frames of one environment share, see `env.frame.Context`.
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
        "action" `(N, A)`, the "age" `(N,)`, or a column of an event."""
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
    """`fn(frame, **params)` gives `(N, k)` observations.

    Attributes:
        parts: names of its columns in order, and how many of every `sum(parts.values())` each has:
            {"pos": 3, "linvel": 3} of B bodies is "pos" in the first 3 B columns and "linvel" in the
            others. See `ImitationEnv.columns`.
    """

    name: str
    fn: TermFunction
    params: Mapping[str, Any] = field(default_factory=dict[str, Any])
    parts: Mapping[str, int] = field(default_factory=dict[str, int])

    def columns(self, first: int, width: int) -> dict[str, slice]:
        """Its columns and those of its parts, by name, where it has `width` columns from `first` on."""
        out, many = {self.name: slice(first, first + width)}, sum(self.parts.values())
        for name, share in self.parts.items():
            size = share * width // many
            out[f"{self.name}.{name}"] = slice(first, first + size)
            first += size
        return out


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
                code="settings-conflict",
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


@dataclass(frozen=True, eq=False)
class Context:
    """What all frames of one environment share.

    layout: where the numbers of packed poses stand.
    local: the turns of the hinged bodies `(N, J, 4)` of coordinates `(N, 7 + n)`.
    roots: `(B,)` each body's root, as a body of the model.
    hinges: how many there are; the rest of an action is the residual's.
    residual: the kind of residual force, None without.
    left: `(3,)` the root's axis by which headings are taken, see `TaskConfig.left`; None: its twist.
    """

    layout: PoseLayout
    local: Callable[[Tensor], Tensor]
    roots: Tensor
    hinges: int
    residual: Residual | None
    left: Tensor | None


def headed(pose: Pose, left: Tensor | None) -> Pose:
    """Poses as an environment sees them, with headings by the root's axis `left (3)`; packed ones hold
    the twist."""
    return pose if left is None else replace(pose, heading=lateral_heading(pose.qpos[..., 3:7], left))


def hinge_torques(servos: Tensor, damping: Tensor) -> Tensor:
    """What both of MuJoCo's generalized forces `(N, 6 + n)` exert on each hinge, N m `(N, n)`."""
    return (servos + damping)[:, 6:].float()


def sim(frame: Frame) -> Pose:
    """The simulated characters; read it before the next step."""

    def linvel() -> Tensor:
        # v(xpos) = v(c) + omega x (xpos - c), see `sim.body_linear_velocity_w`.
        arm = pose.pos - frame.source("subtree_com").index_select(1, frame.context.roots).float()
        return frame.source("cvel")[:, 1:, 3:].float() + torch.linalg.cross(pose.angvel, arm)

    def heading() -> Tensor:
        root, left = pose.qpos[:, 3:7], frame.context.left
        return heading_quat(root) if left is None else lateral_heading(root, left)

    pose = LazyPose(
        qpos=lambda: frame.source("qpos").float(),
        qvel=lambda: frame.source("qvel").float(),
        pos=lambda: frame.source("xpos")[:, 1:].float(),
        quat=lambda: frame.source("xquat")[:, 1:].float(),
        linvel=linvel,
        angvel=lambda: frame.source("cvel")[:, 1:, :3].float(),
        com=lambda: frame.source("subtree_com")[:, 1].float(),
        local=lambda: frame.context.local(pose.qpos),
        heading=heading,
    )
    return pose


def ref(frame: Frame) -> Pose:
    """What the goal asks for now."""
    return headed(frame.context.layout.unpacked(frame.source("goal")), frame.context.left)


def ahead(frame: Frame) -> Pose | None:
    """What the goal asks for one control step later."""
    return headed(frame.context.layout.unpacked(frame.source("ahead")), frame.context.left)


def window(frame: Frame) -> Pose:
    """What the goal asks for at the steps of the task's window, fields `(N, K, ...)`."""
    return headed(frame.context.layout.unpacked(frame.source("window")), frame.context.left)


def place(frame: Frame) -> PosePlace:
    """Where in its clip the goal is."""
    return frame.context.layout.place(frame.source("goal"))


def phase(frame: Frame) -> Tensor:
    """Place in the clip, 0 to 1 `(N,)`."""
    return frame.place.phase


def min_height(frame: Frame) -> Tensor:
    """The clip's lowest root height, m `(N,)`."""
    return frame.place.low


def action(frame: Frame) -> Tensor:
    """The hinges' part of the last action, as it acted `(N, n)`."""
    return frame.source("action")[:, : frame.context.hinges]


def action_before(frame: Frame) -> Tensor:
    """The same of the step before `(N, n)`."""
    return frame.source("action_before")[:, : frame.context.hinges]


def residual(frame: Frame) -> Tensor:
    """The last step's residual action, unscaled `(N, k)`."""
    return frame.source("action")[:, frame.context.hinges :]


def reg(frame: Frame) -> Tensor:
    """The regularizer of the residual `(N,)`, 1 without help."""
    kind: Residual | None = frame.context.residual
    return torch.ones_like(frame.phase) if kind is None else kind.regularizer(frame.residual)


def age(frame: Frame) -> Tensor | None:
    """Control steps since the episode began `(N,)`."""
    return frame.source("age")


def torque(frame: Frame) -> Tensor | None:
    """What servos and damping exert on each hinge at the end of the step, N m `(N, n)`."""
    return hinge_torques(frame.source("qfrc_actuator"), frame.source("qfrc_damper"))


def torque_before(frame: Frame) -> Tensor | None:
    """The same at the begin of the step `(N, n)`."""
    return frame.source("torque_before")


def linvel_before(frame: Frame) -> Tensor:
    """Velocities of the bodies less the reference's at the begin of the step, m/s `(N, B, 3)`."""
    return frame.source("linvel_before")


def point(frame: Frame) -> PointGoal | None:
    """The place of the reference's root, from the recovery event."""
    return None


def spared(frame: Frame) -> Tensor | None:
    """`(N,)` bool, episodes that cannot end in this step; the recovery says them."""
    return None


def sizes(frame: Frame) -> Tensor | None:
    """Sizes of each character's body; the body assignment says them."""
    return None


#: All functions of this file by name.
STANDARD: dict[str, Observable] = {
    name: fn
    for name, fn in vars().copy().items()
    if getattr(fn, "__module__", "") == __name__
    and isinstance(fn, FunctionType)
    and name not in ("headed", "hinge_torques")
}
