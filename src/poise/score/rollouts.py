"""The padded tensors of one evaluation, whether a motion was done, and clip by clip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import torch
from torch import Tensor

from poise.env import ImitationEnv
from poise.errors import PoiseError
from poise.metrics import (
    Shapes,
    SuccessRule,
    fallen,
    first_lasting,
    has_lost,
    mpjpe_global,
    mpjpe_root,
    off_feet,
    success,
)
from poise.score.card import NAN, Weighting


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
                f"pos must be (E, T, B, 3) and not empty, got {tuple(self.pos.shape)}",
                "rollouts",
                code="wrong-shape",
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
                f"the reward has no 'total' beside its terms {sorted(self.reward)}",
                "rollouts",
                code="key-missing",
            )
        for name in ("fps", "mass"):
            if not 0 < getattr(self, name) < float("inf"):
                raise PoiseError(
                    f"{name} must be above 0, got {getattr(self, name)}", "rollouts", code="out-of-range"
                )
        if self.clip_names and not 0 <= int(self.clip.min()) <= int(self.clip.max()) < len(
            self.clip_names
        ):
            raise PoiseError(
                f"clip holds indices {int(self.clip.min())} to {int(self.clip.max())}, "
                f"but there are {len(self.clip_names)} clip names",
                "rollouts",
                code="index-outside",
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
        raise PoiseError(
            f"{name} must be {shape}, got {tuple(value.shape)}", "rollouts", code="wrong-shape"
        )


class EpisodeOutcomes(NamedTuple):
    """won `(E,)`: reached the end and broke the rule in no frame. mask `(E, T)`: the frames that count,
    up to and including the first that broke the rule, since what comes after is not tracking. failed_at
    `(E,)`: the frame of failure, -1 for none; the last one where an episode was stopped early. uncut
    `(E, T)`: all frames that were simulated, those after a failure among them.
    """

    won: Tensor
    mask: Tensor
    failed_at: Tensor
    uncut: Tensor


def judge(r: RolloutSet, rule: SuccessRule) -> EpisodeOutcomes:
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
    return EpisodeOutcomes(won, mask, torch.where(won, -1, stopped), uncut)


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


class Posture(NamedTuple):
    """How episodes held themselves beside their references.

    Attributes:
        tracked: `(E,)` double, 1 where an episode succeeded and neither fell nor left its feet, else 0;
            NaN where no head is told.
        fallen_at: `(E,)` the frame from which on it was down for `LASTING_S` while its reference was
            upright, -1 for none; see `metrics.fallen`.
        off_feet_at: `(E,)` the same of its feet, see `metrics.off_feet`.
    """

    tracked: Tensor
    fallen_at: Tensor
    off_feet_at: Tensor


def posture(r: RolloutSet, won: Tensor, mask: Tensor) -> Posture:
    """The posture of every episode in the frames `mask (E, T)`. won: `(E,)` which succeeded."""
    none = torch.full_like(r.lengths.long(), -1)
    if r.head is None:
        return Posture(torch.full(won.shape, torch.nan, dtype=torch.float64), none, none)
    down = first_lasting(fallen(r.pos, r.ref_pos, r.head, r.root) & mask, r.fps)
    off = none
    if r.shapes is not None and r.feet:
        away = off_feet(r.pos, r.quat, r.ref_pos, r.ref_quat, r.shapes, r.feet)
        off = first_lasting(away & mask, r.fps)
    return Posture((won & (down < 0) & (off < 0)).double(), down, off)


#: Control steps between looks at whether anything is left to see, which a GPU must be waited for.
LOOK = 16


@dataclass(frozen=True, eq=False)
class ClipResults:
    """What E clips came to, from frame 0 or from several; one row per clip.

    clip: its index. succeeded: bool. frames: its frames. tracked: those before it failed, or all.
    mpjpe_mm, global_mm: means over the frames up to the one that failed, with the root's error and
    without.
    """

    clip: Tensor
    succeeded: Tensor
    frames: Tensor
    tracked: Tensor
    mpjpe_mm: Tensor
    global_mm: Tensor

    @property
    def rate(self) -> float:
        """Share of the clips that succeeded."""
        return float(self.succeeded.double().mean())

    @property
    def tracked_share(self) -> float:
        """Share of the frames of all clips before they failed."""
        return float(self.tracked.sum() / self.frames.sum())

    @property
    def error_mm(self) -> float:
        """Global error over the frames of all clips, mm."""
        seen = (self.tracked + (~self.succeeded).long()).double()
        return float((self.global_mm * seen).sum() / seen.sum())

    def spread(self, values: Tensor, clips: int) -> Tensor:
        """`values (E,)` in a row of all `clips`; 0 for those that were not evaluated."""
        out = values.new_zeros(clips)
        out[self.clip] = values
        return out

    def hardest(self, count: int) -> list[int]:
        """Clips that failed, those first of which the least was tracked."""
        share = (self.tracked / self.frames)[~self.succeeded]
        return self.clip[~self.succeeded][share.argsort(stable=True)][:count].tolist()


class ClipJudge:
    """Observes clips from their first frames and keeps of each what it came to.

    PHC's evaluation: a clip fails where the mean distance of the bodies exceeds 0.5 m in any frame
    (`metrics.has_lost`). The judge records no frames, so that a library of thousands of clips can be
    evaluated while a policy learns it.

    last: `(E,)` the last frame of each world's clip.
    """

    def __init__(self, last: Tensor):
        self.last = last
        self.alive, self.tracked = torch.ones_like(last, dtype=torch.bool), torch.ones_like(last)
        # The first frame is the clip's own.
        self.local, self.far = (torch.zeros_like(last, dtype=torch.float64) for _ in range(2))
        self.count = torch.ones_like(self.local)

    def see(self, env: ImitationEnv, step: int) -> bool:
        """Adds one frame of each clip that has not ended or failed."""
        if step == 0:
            return False
        sim, ref = env.pose().pos, env.goal_pose().pos
        distance, counted = mpjpe_global(sim, ref), self.alive & (step <= self.last)
        # A world that went bad has no distance, and has failed.
        good = ~has_lost(sim, ref) & distance.isfinite()
        known = counted & distance.isfinite()
        self.far += torch.where(known, distance, 0.0)
        self.local += torch.where(known, mpjpe_root(sim, ref), 0.0)
        self.count += known
        self.alive &= good | ~counted
        self.tracked += counted & good
        return step % LOOK == 0 and not bool((self.alive & (step < self.last)).any())

    def results(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Success, frames tracked, mean errors without and with the root's; `(E,)` on the CPU."""
        found = self.alive, self.tracked, self.local / self.count, self.far / self.count
        return found[0].cpu(), found[1].cpu(), found[2].cpu(), found[3].cpu()
