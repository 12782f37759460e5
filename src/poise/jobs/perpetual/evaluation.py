"""Every clip of a library from its first frame, and what is known of them while they are learned."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from poise.env import Acts
from poise.env.recovery.falls import fall_states
from poise.errors import PoiseError
from poise.learn import Convergence, Decision, HardNegatives, PolicyBundle
from poise.learn.checkpoint import State, prefixed, take, under, write_atomic
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import standing
from poise.recipes.perpetual_settings import Perpetual
from poise.score import ClipJudge, ClipResults, RecoveryCard, recovery_card, simulate, trial_task
from poise.score.episodes import Observer
from poise.sim import make_backend

#: The file of a run folder with every evaluation of every clip.
SUCCESS = "success.csv"
COLUMNS = (
    "iteration", "stage", "help_n", "clip", "succeeded", "frames", "tracked", "mpjpe_mm",
    "mpjpe_global_mm",
)  # fmt: skip
#: The stage of the finished policy's rows.
FINAL_STAGE = "final"
#: Clips that are simulated at once.
WORLDS = 512


@torch.no_grad()
def evaluate_clips(
    imitation: Imitation,
    policy: Acts,
    clips: Tensor | None = None,
    help_scale: float | Tensor = 0.0,
    threads: int = 0,
    device: str = "cpu",
    worlds: int = WORLDS,
    on_batch: Callable[[int, int], None] | None = None,
    starts: int = 1,
    observers: Sequence[Observer] = (),
) -> ClipResults:
    """Simulates `clips (E,)`, all by default, from their first frames with the deterministic policy.

    Args:
        starts: from so many frames of each, evenly spread; a clip succeeds where it does from all of
            them, and its frames are those of all.
        help_scale: what is left of the residual force's limits, or of those of each clip or motion bin
            of the library, as the task's `help_by` says.
        on_batch: told how many of how many clips are done. observers: see each step, too.
    """
    reference = imitation.reference
    length, second = reference.length.cpu(), round(reference.rate_hz)
    clips = torch.arange(len(length)) if clips is None else clips.cpu()
    if isinstance(policy, PolicyBundle):
        policy = policy.copy().to(device)
    # Of what begins in the last second little is seen.
    spread = (length[clips] - second).clamp(min=1)[:, None] * torch.arange(starts) // starts
    clip, frame = clips.repeat_interleave(starts), spread.flatten()
    # Episodes of like length share a batch, so that few worlds wait for others.
    order = (length[clip] - frame).argsort(stable=True)
    parts: list[tuple[Tensor, ...]] = []
    for rows in order.split(worlds):
        at = clip[rows], frame[rows]
        parts.append(_batch(imitation, policy, *at, help_scale, threads, device, observers))
        if on_batch is not None:
            on_batch(sum(len(p[0]) for p in parts) // starts, len(clips))
    back = order.argsort()
    won, tracked, local, far = (torch.cat(x)[back].view(-1, starts) for x in zip(*parts, strict=True))
    seen = (tracked + (~won).long()).double()
    local, far = ((x * (seen / seen.sum(1, keepdim=True))).sum(1) for x in (local, far))
    frames = (length[clips][:, None] - spread).sum(1)
    return ClipResults(clips, won.all(1), frames, tracked.sum(1), local, far)


def _batch(
    imitation: Imitation,
    policy: Acts,
    clip: Tensor,
    frame: Tensor,
    scale: float | Tensor,
    threads: int,
    device: str,
    observers: Sequence[Observer],
) -> tuple[Tensor, ...]:
    """Success, frames tracked, mean errors `(E,)` of episodes that are simulated together."""
    task = imitation.bare(groups=isinstance(scale, Tensor))
    env = task.env(len(clip), None, False, threads, None, scale, device, guard=False)
    clip, frame = clip.to(env.device), frame.to(env.device)
    last = imitation.reference.length.to(env.device)[clip] - 1 - frame
    judge = ClipJudge(last)
    try:
        # A controller that looks ahead does so from this world.
        if callable(watch := getattr(policy, "watch", None)):
            watch(env)
        simulate(env, policy, env.reset_to(clip, frame), int(last.max()), judge, *observers)
    finally:
        env.close()
    return judge.results()


class EvaluationLog:
    """Every evaluation of every clip as a CSV file, after a resumed run as after an uninterrupted one.

    last: iterations after this one are dropped from an existing file.
    """

    def __init__(self, folder: Path, names: tuple[str, ...], last: int = 0):
        self.path, self.names = folder / SUCCESS, names
        # The finished policy is evaluated anew at the end of each training.
        rows = [r for r in self._read() if int(r[0]) <= last and r[1] != FINAL_STAGE]
        self._replace(rows)

    def add(self, iteration: int, stage: str, help_n: float | Tensor, results: ClipResults) -> None:
        """Notes one evaluation. help_n: what the help was limited to, N, or for each clip of the library
        `(C,)`."""
        r = results
        given = (
            help_n[r.clip]
            if isinstance(help_n, Tensor)
            else torch.tensor(help_n, dtype=torch.float64).expand(len(r.clip))
        )
        columns = (given, r.clip, r.succeeded, r.frames, r.tracked, r.mpjpe_mm, r.global_mm)
        with self.path.open("a", newline="", encoding="utf-8") as file:
            write = csv.writer(file)
            for newtons, clip, won, frames, tracked, local, far in zip(
                *(c.tolist() for c in columns), strict=True
            ):
                write.writerow(
                    (iteration, stage, f"{newtons:.4g}", self.names[clip], int(won), frames, tracked,
                     f"{local:.4f}", f"{far:.4f}")
                )  # fmt: skip

    def _read(self) -> list[list[str]]:
        if not self.path.exists():
            return []
        with self.path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file))[1:]
        # A process that was killed may have left half a line.
        return [r for r in rows if len(r) == len(COLUMNS) and r[0].isdigit()]

    def _replace(self, rows: list[list[str]]) -> None:
        text = io.StringIO(newline="")
        write = csv.writer(text)
        write.writerow(COLUMNS)
        write.writerows(rows)
        write_atomic(self.path, text.getvalue().encode())


#: Distance from the reference, m, at which trials far from it begin (PHC, Sec. 4.2).
FAR = 3.0


def check_falls(imitation: Imitation, count: int = 32) -> None:
    """Lets some characters fall, so that a body that never comes to lie is known before the training.

    Raises:
        PoiseError: they do not.
    """
    recovery = imitation.task.recovery
    if recovery is None:
        return
    backend = make_backend(imitation.model, count, "cpu", threads=1)
    try:
        drop = replace(recovery.drop, count=min(count, recovery.drop.count))
        fall_states(backend, imitation.humanoid, imitation.task.pd, drop, int(imitation.config.seed))
    except PoiseError as problem:
        hint = "Train without recovery: --no-recovery"
        raise PoiseError(problem.what, "recovery", hint, code=problem.code) from None
    finally:
        backend.close()


def try_recovery(
    imitation: Imitation, policy: Acts, trials: int, threads: int = 0, device: str = "cpu"
) -> RecoveryCard:
    """Trials of every kind of fail-state against a reference that stands, without help.

    imitation: with the task of a stage that learns recovery. The same falls and directions every time.
    """
    config: Perpetual = imitation.config
    clip, frame = standing(imitation.reference)
    if isinstance(policy, PolicyBundle):
        policy = policy.copy().to(device)
    recovery_clips = imitation.recovery_clips
    tried = trial_task(imitation.task, FAR, trials, recovery_clips is not None)
    tried = replace(imitation, task=tried).bare()
    return recovery_card(
        lambda n: tried.env(n, None, False, threads, None, 0.0, device, guard=False),
        policy, trials, method=config.method, clip=clip, frame=frame, seconds=config.recovering.seconds,
        recovery_clips=recovery_clips,
    )  # fmt: skip


def back(card: RecoveryCard) -> tuple[int, int]:
    """How many of how many trials of all kinds were back in the last of the card's times."""
    return sum(round(r.within[-1] * r.trials) for r in card.rows), sum(r.trials for r in card.rows)


#: Help that is less by this share of its limit is a gain of a stage; less of a difference between the
#: means of clips that have help of their own is none.
LESS_HELP = 0.01
#: What a share of trials of recovery is worth beside the same share of clips, where both are learned.
RECOVERY_WORTH = 0.25


def mean_help(scale: float | Tensor, clips: Tensor) -> float:
    """The share of the help's limits that an evaluation of `clips (E,)` had: `scale`, or the mean of
    those of the clips, of the library's `(C,)`. It is 0 only where no clip had any."""
    return float(scale[clips].double().mean()) if isinstance(scale, Tensor) else scale


def _in_steps(scale: float) -> float:
    """Whole steps of `LESS_HELP`, counted up, so that a little help never passes for none."""
    # The mean of float32 scales, such as 0.3, may lie a hair above the step that is meant.
    return LESS_HELP * max(1, ceil(scale / LESS_HELP - 1e-4)) if scale > 0 else 0.0


class StageRecord:
    """The evaluations of a run; everything by which stages end and begin.

    Args:
        config: the recipe's settings.
        length: `(C,)` frames of the clips. Where none fails all are drawn alike but for those that are
            longer than an episode, by as much as they are: then each second is seen about as often.

    Attributes: `owner (C,)`, the primitive that learned each clip, from 0; `best`, the state of the
    stage's policy that did best, which had `best_failed (C,)`; `seen`, how many clips (trials of the
    recovery primitive) of how many succeeded in the last evaluation; `recovery`, the best trials of the
    recovery primitive as JSON data.
    """

    def __init__(self, config: Perpetual, length: Tensor):
        clips = len(length)
        base = (length.cpu() - 1).clamp(min=config.horizon).double()
        self.mining = HardNegatives(clips, config.mining, base)
        self.convergence = Convergence(config.convergence)
        self.owner = torch.zeros(clips, dtype=torch.long)
        self.recovery: dict[str, Any] | None = None
        self.begin(torch.ones(clips, dtype=torch.bool))

    def begin(self, member: Tensor) -> None:
        """Another stage, on the clips `member (C,)` bool; what is counted per stage begins anew."""
        self.mining.next_stage(member)
        self.convergence.reset()
        self.least = 1.0
        self.best: State = {}
        self.best_key: tuple[float, ...] = ()
        self.best_failed = torch.zeros_like(self.mining.member)
        self.seen: tuple[int | None, int] = (None, int(member.sum()))

    @property
    def clips(self) -> Tensor:
        """Indices of the stage's clips."""
        return self.mining.member.nonzero().squeeze(-1)

    @property
    def hard(self) -> Tensor:
        """`(C,)` bool, what the next primitive is to learn."""
        return self.mining.hard | self.best_failed

    def record(
        self,
        results: ClipResults,
        policy: PolicyBundle,
        scale: float | Tensor,
        recovered: float = 0.0,
    ) -> None:
        """Notes what `policy` did with the stage's clips, with the share `scale` of the help, or for
        each clip of the library its own `(C,)`.

        The best policy is the one with the least `mean_help`, of those the one with the most clips, of
        those the one with the most frames before a failure, of those the one with the smallest error.
        What was done without help counts before all that was not, and since a stage ends with an
        evaluation without, its best policy is of those. Which clips have help makes no difference; as
        the scales of clips go up and down each on its own, means are compared in steps of `LESS_HELP`.
        A clip that fails with the help that it has left counts as failed for mining and, unless a
        stage's end shows something else, for the next primitive.

        recovered: the share of its trials that were back, where the stage learns recovery, too.
        """
        member = self.mining.member
        won = results.spread(results.succeeded, len(member))
        self.mining.record(won, member)
        self.seen = (int(won.sum()), len(results.clip))
        # Less help counts before more clips, more clips before more frames and a smaller error.
        own = isinstance(scale, Tensor)
        left = _in_steps(mean_help(scale, results.clip)) if own else scale
        won_share = results.rate + RECOVERY_WORTH * recovered
        key = (-left, won_share, results.tracked_share, -results.error_mm)
        if not self.best or key > self.best_key:
            self.best, self.best_key, self.best_failed = policy.state(), key, member & ~won

    def record_trials(self, card: RecoveryCard, policy: PolicyBundle) -> None:
        """Notes what `policy` did with trials of recovery alone; of equals the later one is the best."""
        won, tried = self.seen = back(card)
        if not self.best or won / tried >= self.best_key[0]:
            self.best, self.best_key = policy.state(), (won / tried,)
            self.recovery = card.to_dict()

    def decide(self, scale: float | Tensor) -> Decision:
        """What the last evaluation says of the stage. scale: its share of the help, or `(C,)` of clips.

        A stage in which any clip has help is never solved; that its clips need less help, on average,
        is a gain.
        """
        scale = mean_help(scale, self.clips)
        succeeded, clips = self.seen
        assert succeeded is not None
        improved = scale < self.least - LESS_HELP
        self.least = min(self.least, scale)
        decision = self.convergence.add(succeeded, clips, improved)
        return "go on" if decision == "solved" and scale > 0 else decision

    def state(self) -> State:
        """Copies of all tensors."""
        own = {"owner": self.owner.clone(), "best_failed": self.best_failed.clone()}
        mining, convergence = prefixed("mining", self.mining.state()), self.convergence.state()
        return own | mining | convergence | prefixed("best", self.best)

    def facts(self) -> dict[str, Any]:
        """The rest of what `load` takes, as JSON data."""
        return {
            "least": self.least,
            "best_key": list(self.best_key),
            "seen": list(self.seen),
            "recovery": self.recovery,
        }

    def load(self, state: Mapping[str, Tensor], facts: Mapping[str, Any]) -> None:
        """Goes on from `state` and `facts`."""
        self.mining.load_state(under("mining", state))
        self.convergence.load_state(state)
        self.owner, self.best_failed = take(state, "owner"), take(state, "best_failed")
        self.best, self.best_key = under("best", state), tuple(facts["best_key"])
        self.least = facts["least"]
        succeeded, clips = facts["seen"]
        self.seen = (succeeded, clips)
        self.recovery = facts.get("recovery")
