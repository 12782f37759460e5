"""Protocols: an environment as the learner sees it, and a policy as others see it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor


class StepResult(NamedTuple):
    """What one control step of N environments gives back; N rows each, on the env's device.

    The tensors need to stay valid only until the next call of `step`.
    """

    obs: Tensor
    """`(N, O)` float32, observation to act on next: of the new episode where one has ended."""
    reward: Tensor
    """`(N,)` float32, reward of the step taken."""
    terminated: Tensor
    """`(N,)` bool, the task ended there, failed or finished: nothing follows, its value is 0."""
    truncated: Tensor
    """`(N,)` bool, it was cut by a time-out: the value of `final_obs` is bootstrapped. Where both
    are set, `terminated` decides."""
    final_obs: Tensor
    """`(N, O)` float32, observation of the last state before the automatic reset; rows of
    episodes that go on may hold anything finite, such as `obs`."""
    log: Mapping[str, float]
    """Means over this step for the log (reward terms, errors, help), cheap to make. Keys keep
    their names all through a run; one that carries a reward term helps to name a faulty term."""
    failed: Tensor | None = None
    """`(N,)` bool, which of the terminated episodes failed, for the statistics; None: all."""


class VecEnv(Protocol):
    """N environments stepped together, each reset automatically when its episode ends."""

    num_envs: int
    """N, the number of rows."""
    num_obs: int
    """O, the width of an observation."""
    num_actions: int
    """A, the width of an action."""
    device: torch.device
    """Where all tensors of the environment live."""

    def reset(self) -> Tensor:
        """Starts a new episode in every row and returns its observation `(N, O)` float32."""
        ...

    def step(self, actions: Tensor) -> StepResult:
        """Applies actions `(N, A)` float32, unbounded, for one control step."""
        ...

    def state(self) -> dict[str, Tensor]:
        """A copy of everything that a bit-exact continuation needs: the simulation, the episode
        clocks and the state of its random generator. It is saved in every checkpoint."""
        ...

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Continues from what `state` returned; no reset is needed before the next `step`."""
        ...

    def close(self) -> None:
        """Frees threads and memory; calling it twice is allowed."""
        ...


class FeatureSource(Protocol):
    """What a motion prior asks of an environment beside the `VecEnv`: features of how it moves.

    PHC's 196 are: root height, root rotation (6D) and velocities (3 + 3) in the heading frame, joint
    rotations (6D), hinge velocities, hands and feet in the heading frame; any others will do.
    """

    num_envs: int
    """N, the number of rows."""
    device: torch.device
    """Where the features live."""

    @property
    def num_features(self) -> int:
        """F, the width of the features of one frame."""
        ...

    def features(self) -> Tensor:
        """`(N, F)` float32 of the states that the last `step` reached, before any automatic reset.

        It needs to stay valid only until the next call of `step`.
        """
        ...

    def past(self, rows: Tensor, count: int) -> Tensor | None:
        """`(n, count, F)` of the new episodes that the last `step` began in `rows (n,)`: the frames up
        to the start and, last, the start itself, as the clips have them. NaN for rows without, such
        as those that start fallen, or None if there are none at all; those have no style reward of
        their own until they have moved for `count` frames."""
        ...


class DemoSampler(Protocol):
    """Draws windows of the clips, as `FeatureSource` would see them."""

    def __call__(self, count: int, generator: torch.Generator) -> Tensor:
        """`(count, W F)` float32, oldest frame first; drawn by `generator`, which lives on the CPU."""
        ...


class Style(Protocol):
    """What a trainer asks of a reward that it learns itself, such as `Amp`."""

    @property
    def shape(self) -> dict[str, Any]:
        """JSON data that a checkpoint must share for its state to be loaded."""
        ...

    def begin(self, horizon: int) -> None:
        """Before a rollout of `horizon` steps."""
        ...

    def step(self, done: Tensor) -> None:
        """After each step of the environment; `done (N,)` bool says where an episode ended."""
        ...

    def reward(self, task: Tensor) -> Tensor:
        """The total reward `(T, N)` of a rollout with the task reward `task (T, N)`."""
        ...

    def update(self) -> dict[str, float]:
        """Learns from the rollout; numbers for the log."""
        ...

    def state(self) -> dict[str, Tensor]:
        """Copies of everything that a bit-exact continuation needs; what differs between processes
        that train together lies under "own/"."""
        ...

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continues from what `state` returned."""
        ...


class Teacher(Protocol):
    """What cloning learns from: it knows the environment's state and what to do there.

    It may have an attribute `known`, `(N,)` bool: where the last `act` is worth learning.
    """

    def act(self, obs: Tensor) -> Tensor:
        """Actions `(N, A)` for the environment as it stands now, with the observation `obs (N, O)`."""
        ...


class Lessons(Protocol):
    """What a learner is taught where it has come to itself, such as by `plan.LookaheadTeacher`."""

    def teach(
        self, policy: Policy, value: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor, dict[str, float]]:
        """Raw observations `(n, O)` of states that the policy came to, the actions `(n, A)` that it
        should take there, and numbers for the log. value: the return `(N,)` that the policy is still to
        earn, of raw observations `(N, O)`."""
        ...

    def state(self) -> dict[str, Tensor]:
        """Everything that a bit-exact continuation needs."""
        ...

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continues from what `state` returned."""
        ...

    def close(self) -> None:
        """Frees the worlds that it teaches in."""
        ...


class Policy(Protocol):
    """What acts: evaluation, viewers and live loops ask for no more than this."""

    @property
    def num_obs(self) -> int:
        """O, the width of an observation."""
        ...

    @property
    def num_actions(self) -> int:
        """A, the width of an action."""
        ...

    def act(self, obs: Tensor) -> Tensor:
        """The deterministic action `(N, A)` for raw, not normalised, observations `(N, O)`."""
        ...
