"""Every clip of a library from its first frame, the table of all such evaluations, and trials of
recovery from PHC's fail-states."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from poise.env import Acts
from poise.env.recovery.falls import fall_states
from poise.errors import PoiseError
from poise.eval import ClipJudge, ClipResults, RecoveryCard, recovery_card, simulate, trial_task
from poise.learn import PolicyBundle
from poise.learn.checkpoint import write_atomic
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual.config import Perpetual
from poise.recipes.perpetual.recovery import standing
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
) -> ClipResults:
    """Simulates `clips (E,)`, all by default, from their first frames with the deterministic policy.

    Args:
        starts: from so many frames of each, evenly spread; a clip succeeds where it does from all of
            them, and its frames are those of all.
        help_scale: what is left of the residual force's limits, or of those of each clip or motion bin
            of the library, as the task's `help_by` says.
        on_batch: told how many of how many clips are done.
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
        parts.append(_batch(imitation, policy, clip[rows], frame[rows], help_scale, threads, device))
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
) -> tuple[Tensor, ...]:
    """Success, frames tracked, mean errors `(E,)` of episodes that are simulated together."""
    task = imitation.bare(groups=isinstance(scale, Tensor))
    env = task.env(len(clip), None, False, threads, None, scale, device, guard=False)
    clip, frame = clip.to(env.device), frame.to(env.device)
    last = imitation.reference.length.to(env.device)[clip] - 1 - frame
    judge = ClipJudge(last)
    try:
        simulate(env, policy, env.reset_to(clip, frame), int(last.max()), judge)
    finally:
        env.close()
    return judge.results()


class History:
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
        raise PoiseError(problem.what, "recovery", hint) from None
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
