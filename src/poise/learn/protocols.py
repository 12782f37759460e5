"""What the learner asks of an environment, and what others may ask of a policy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import torch
from torch import Tensor


class Step(NamedTuple):
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
    """`(N, O)` float32, observation of the last state before the automatic reset; rows whose
    episode goes on may hold anything finite, such as `obs`."""
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

    def step(self, actions: Tensor) -> Step:
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
