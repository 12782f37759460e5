"""Every clip of a library from its first frame: which are done to their end, and how closely.

PHC's evaluation: the policy acts without noise, and a clip fails where the mean distance of the bodies
exceeds 0.5 m in any frame. No frame after a failure is simulated for its own sake, so that a library of
thousands of clips is evaluated while it is learned.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from poise.env import Acts
from poise.learn import PolicyBundle
from poise.learn.checkpoint import write_atomic
from poise.metrics import mpjpe_global, mpjpe_root, success_rule
from poise.recipes.imitation import Imitation

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


@dataclass(frozen=True, eq=False)
class ClipResults:
    """What E clips came to, from frame 0; one row per clip.

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
) -> ClipResults:
    """Simulates `clips (E,)`, all by default, from their first frames with the deterministic policy.

    Args:
        help_scale: what is left of the residual force's limits, or of those of each clip or moment of
            the library, as the task's `help_by` says.
        on_batch: told how many of how many clips are done.
    """
    reference = imitation.reference
    clips = torch.arange(len(reference.length)) if clips is None else clips
    if isinstance(policy, PolicyBundle):
        policy = policy.copy().to(device)
    # Clips of like length share a batch, so that few worlds wait for others.
    order = reference.length[clips].argsort(stable=True)
    parts: list[tuple[Tensor, ...]] = []
    for rows in order.split(worlds):
        parts.append(_batch(imitation, policy, clips[rows], help_scale, threads, device))
        if on_batch is not None:
            on_batch(sum(len(p[0]) for p in parts), len(clips))
    back = order.argsort()
    succeeded, tracked, local, far = (torch.cat(x)[back] for x in zip(*parts, strict=True))
    return ClipResults(clips, succeeded, reference.length[clips].cpu(), tracked, local, far)


def _batch(
    imitation: Imitation,
    policy: Acts,
    clip: Tensor,
    scale: float | Tensor,
    threads: int,
    device: str,
) -> tuple[Tensor, ...]:
    """Success, frames tracked, mean errors `(E,)` of clips that are simulated together."""
    task = imitation.bare(groups=isinstance(scale, Tensor))
    env = task.env(len(clip), None, False, threads, None, scale, device, guard=False)
    limit = success_rule("phc").limit_m * 1000.0
    last = imitation.reference.length[clip].to(env.device) - 1
    clip = clip.to(env.device)
    alive, tracked = torch.ones_like(clip, dtype=torch.bool), torch.ones_like(clip)
    # The first frame is the clip's own.
    local, far = (torch.zeros(len(clip), dtype=torch.float64, device=env.device) for _ in range(2))
    count = torch.ones_like(local)
    try:
        obs = env.reset_to(clip, torch.zeros_like(clip))
        for t in range(1, int(last.max()) + 1):
            obs = env.step(policy.act(obs)).final_obs
            sim, ref = env.pose().pos, env.reference.gather(env.clip, env.frame).pos
            distance, counted = mpjpe_global(sim, ref), alive & (t <= last)
            # A world that went bad has no distance, and has failed.
            good = distance <= limit
            known = counted & distance.isfinite()
            far += torch.where(known, distance, 0.0)
            local += torch.where(known, mpjpe_root(sim, ref), 0.0)
            count += known
            alive &= good | ~counted
            tracked += counted & good
            if t % 16 == 0 and not bool((alive & (t < last)).any()):
                break
    finally:
        env.close()
    return tuple(x.cpu() for x in (alive, tracked, local / count, far / count))


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
