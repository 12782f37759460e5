"""What stands in the metadata of checkpoints, with its types: files come from strangers, too.

`load_checkpoint(path, TrainerMeta)` refuses, in a sentence, what is missing or of another type.
"""

from __future__ import annotations

from typing import Any, Literal, TypedDict


class _Shape(TypedDict):
    hidden: list[int]
    activation: str
    obs_clip: float


class PolicyShape(_Shape, total=False):
    """What rebuilds the networks of a policy, see `PolicyBundle.shape`."""

    kind: str
    columns: int
    lateral: bool
    composer_hidden: list[int]
    combine: str
    weights: str
    joint: bool


class _Policy(TypedDict):
    num_obs: int
    num_actions: int
    policy: PolicyShape


class PolicyMeta(_Policy, total=False):
    """A checkpoint that holds a policy: alone, or with its trainer."""

    kind: str
    character: str
    metadata: dict[str, Any]
    samples: int
    seconds: float
    iteration: int


class TrainerMeta(_Policy):
    """A checkpoint of a whole trainer, from which a run goes on."""

    metadata: dict[str, Any]
    config: dict[str, Any]
    iteration: int
    samples: int
    seconds: float


class _Layout(TypedDict):
    parents: list[int]
    feet: list[int]
    facing: list[float]


class _Model(TypedDict):
    net: Literal["transformer", "rtn"]
    config: dict[str, Any]
    layout: _Layout
    names: list[str]
    fps: float
    longest: int
    past: int
    meta: dict[str, Any]


class ModelMeta(_Model, total=False):
    """The file of an in-betweening network."""

    example: list[dict[str, Any]]
