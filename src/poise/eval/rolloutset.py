"""The padded tensors of one evaluation, as an evaluator hands them to the score card: which episodes
succeeded, which of their frames count, and sums of figures over those."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.eval.card import NAN, Weighting
from poise.metrics import Shapes, SuccessRule, success


@dataclass(frozen=True, eq=False)
class RolloutSet:
    """E episodes of at most T frames, B bodies, M helped bodies; metres, world, Z up, wxyz.

    pos, ref_pos: `(E, T, B, 3)` m. quat, ref_quat: `(E, T, B, 4)`. Body `root` is the root.
    alive: `(E, T)` bool, the frame was simulated; values in other frames may be anything.
    lengths: `(E,)` frames in the episode; frames from there on are ignored even when alive.
    reached_end: `(E,)` bool, the episode ran to its clip's end (not stopped early).
    force, torque: `(E, T, M, 3)` N and N m, the residual wrench as applied (zeros for no help).
    point_vel, ang_vel: `(E, T, M, 3)` m/s and rad/s, in the frames of force and torque.
    reward: `(E, T)` per term, with "total" among them; empty when no reward was computed.
    clip, start: `(E,)` int, index of the clip and first frame in it. clip_names: one per index.
    fps: frames per second of all tensors. mass: kg.
    feet: body indices of the feet. head: that of the head, None where none is told.
    shapes: the character's geoms; None skips the contact figures.
    limit_n, limit_nm: the help budget per wrench, N and N m; `inf` where it is unlimited.
    ref_min_height: `(E,)` m, lowest root height of the whole reference (rule "rfc_height").
    rule_bodies: bodies the success rule looks at; None for all.
    trial: `(E,)` int, which of several perturbed starts each episode is, see `episodes.perturb`; None
        where starts are exact.
    point: `(E, T, M, 3)` m, where the residual forces acted; None where it was not recorded.
    """

    pos: Tensor
    quat: Tensor
    ref_pos: Tensor
    ref_quat: Tensor
    alive: Tensor
    lengths: Tensor
    reached_end: Tensor
    force: Tensor
    torque: Tensor
    point_vel: Tensor
    ang_vel: Tensor
    clip: Tensor
    start: Tensor
    fps: float
    mass: float
    limit_n: float
    limit_nm: float
    reward: Mapping[str, Tensor] = field(default_factory=dict)
    feet: tuple[int, ...] = ()
    shapes: Shapes | None = None
    clip_names: tuple[str, ...] = ()
    root: int = 0
    head: int | None = None
    ref_min_height: Tensor | None = None
    rule_bodies: tuple[int, ...] | None = None
    trial: Tensor | None = None
    point: Tensor | None = None

    def __post_init__(self) -> None:
        if self.pos.ndim != 4 or self.pos.shape[-1] != 3 or 0 in self.pos.shape:
            raise PoiseError(
                f"pos must be (E, T, B, 3) and not empty, got {tuple(self.pos.shape)}", "rollouts"
            )
        episodes, frames, bodies, _ = self.pos.shape
        helped = self.force.shape[2] if self.force.ndim == 4 else 1
        want: dict[str, tuple[int, ...]] = {
            "quat": (episodes, frames, bodies, 4),
            "ref_pos": (episodes, frames, bodies, 3),
            "ref_quat": (episodes, frames, bodies, 4),
            "alive": (episodes, frames),
        }
        want |= dict.fromkeys(("lengths", "reached_end", "clip", "start"), (episodes,))
        want |= dict.fromkeys(("force", "torque", "point_vel", "ang_vel"), (episodes, frames, helped, 3))
        if self.ref_min_height is not None:
            want["ref_min_height"] = (episodes,)
        if self.trial is not None:
            want["trial"] = (episodes,)
        for name, shape in want.items():
            _check_shape(name, getattr(self, name), shape)
        for name, values in self.reward.items():
            _check_shape(f"reward['{name}']", values, (episodes, frames))
        if self.reward and "total" not in self.reward:
            raise PoiseError(
                f"the reward has no 'total' beside its terms {sorted(self.reward)}", "rollouts"
            )
        for name in ("fps", "mass"):
            if not 0 < getattr(self, name) < float("inf"):
                raise PoiseError(f"{name} must be above 0, got {getattr(self, name)}", "rollouts")
        if self.clip_names and not 0 <= int(self.clip.min()) <= int(self.clip.max()) < len(
            self.clip_names
        ):
            raise PoiseError(
                f"clip holds indices {int(self.clip.min())} to {int(self.clip.max())}, "
                f"but there are {len(self.clip_names)} clip names",
                "rollouts",
            )

    @property
    def valid(self) -> Tensor:
        """`(E, T)` bool: alive and within the episode's length."""
        within = torch.arange(self.pos.shape[1], device=self.pos.device) < self.lengths.unsqueeze(-1)
        return self.alive.bool() & within

    def episode(self, row: int) -> RolloutSet:
        """One of the episodes alone."""
        rows = slice(row, row + 1)
        own = {f.name: v[rows] for f in fields(self) if isinstance(v := getattr(self, f.name), Tensor)}
        return replace(self, **own, reward={name: v[rows] for name, v in self.reward.items()})

    def clip_name(self, index: int) -> str:
        """The name of clip `index`, or its number where no names were given."""
        return self.clip_names[index] if self.clip_names else str(index)


def _check_shape(name: str, value: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(value.shape) != shape:
        raise PoiseError(f"{name} must be {shape}, got {tuple(value.shape)}", "rollouts")


class Judged(NamedTuple):
    """won `(E,)`: reached the end and broke the rule in no frame. mask `(E, T)`: the frames that count,
    up to and including the first that broke the rule, since what comes after is not tracking. failed_at
    `(E,)`: the frame of failure, -1 for none; the last one where an episode was stopped early. uncut
    `(E, T)`: all frames that were simulated, those after a failure among them.
    """

    won: Tensor
    mask: Tensor
    failed_at: Tensor
    uncut: Tensor


def judge(r: RolloutSet, rule: SuccessRule) -> Judged:
    """Judges every episode by `rule`; a state that is not finite fails and counts in no figure."""
    valid = r.valid
    frame = torch.arange(r.pos.shape[1], device=r.pos.device)
    outcome = success(
        r.pos,
        r.ref_pos,
        torch.where(valid, frame + 1, 0).amax(1),
        rule,
        bodies=r.rule_bodies,
        root=r.root,
        ref_min_height=r.ref_min_height,
    )
    won = outcome.success & r.reached_end.bool() & valid.any(1)
    last = torch.where(outcome.first_fail >= 0, outcome.first_fail, r.pos.shape[1])
    # A state that blew up is a failure, not a number to average.
    finite = r.pos.isfinite().flatten(2).all(2) & r.quat.isfinite().flatten(2).all(2)
    uncut = valid & finite
    mask = uncut & (frame <= last.unsqueeze(-1))
    # An episode that was stopped without breaking the rule failed at its last valid frame.
    stopped = torch.where(outcome.first_fail >= 0, outcome.first_fail, valid.sum(1) - 1)
    return Judged(won, mask, torch.where(won, -1, stopped), uncut)


@dataclass(frozen=True, eq=False)
class Sums:
    """Sum and count of one figure per episode, so that either weighting is a division away."""

    total: Tensor
    count: Tensor

    @staticmethod
    def of(values: Tensor, mask: Tensor) -> Sums:
        """From `(E, ...)` values under a mask of the same shape."""
        kept = torch.where(mask, values, torch.zeros_like(values)).double()
        return Sums(kept.flatten(1).sum(1), mask.flatten(1).sum(1))

    @staticmethod
    def cat(parts: Sequence[Sums]) -> Sums:
        """Of the episodes of all parts, one after another."""
        return Sums(torch.cat([p.total for p in parts]), torch.cat([p.count for p in parts]))

    def mean(self, rows: Tensor, weighting: Weighting) -> float:
        """Over the episodes `rows (E,)` bool; NaN when they hold no sample."""
        rows = rows & (self.count > 0)
        if not bool(rows.any()):
            return NAN
        total, count = self.total[rows], self.count[rows]
        return float(total.sum() / count.sum() if weighting == "frame" else (total / count).mean())
