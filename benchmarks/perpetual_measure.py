"""What `perpetual.py` measures of one run: tables, recovery, composer and primitives."""

from __future__ import annotations

import hashlib
import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from field.card import FieldTable
from field.table import field_table
from speed.stance import relaxed_stance
from torch import Tensor

from poise.env import Acts, ImitationEnv, Reference
from poise.errors import PoiseError
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.library.files import BACKWARDS, MIRRORED, matches, subject_of
from poise.jobs.library.folder import library_of
from poise.jobs.open import open_run
from poise.jobs.perpetual.evaluation import evaluate_clips
from poise.jobs.run_file import RUN_FILE
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.learn import LATEST, PolicyBundle, load_checkpoint, load_policy
from poise.learn.composer import Composer
from poise.learn.primitives import primitive
from poise.motion import Clip, ClipLibrary
from poise.recipes.imitation import Imitation
from poise.score import ClipResults
from poise.score.episodes import run_episodes
from poise.score.recovered import KINDS, recovery_card, trial_task
from poise.score.rollouts import RolloutSet
from poise.settings import to_data

Tell = Callable[[str], None]
#: Frames of all episodes that are recorded at once, which bounds the memory of a table.
AT_ONCE = 60_000
#: Rotations (as quaternion numbers) that differ by less are those of one clip.
SAME = 1e-3


@dataclass(frozen=True, eq=False)
class Run:
    """A run of `poise train perpetual`, finished or not, with its latest policy.

    owner: `(C,)`, the primitive that learned each clip, from 0; None where that is not known.
    """

    name: str
    folder: Path
    imitation: Imitation
    tracker: Tracker
    owner: Tensor | None

    @classmethod
    def open(cls, name: str, folder: Path, policy: Path | None = None) -> Run:
        """The run in a folder, or in the folder `run` within it; with another policy, on its clips."""
        if not (folder / RUN_FILE).exists():
            folder = folder / "run"
        if not (folder / RUN_FILE).exists():
            raise PoiseError(f"is no run folder: there is no {RUN_FILE} in it", folder, code="not-a-run")
        run = open_run(folder)
        owner = None
        if (folder / LATEST).exists():
            owner = load_checkpoint(folder / LATEST)[0].get("ledger/owner")
        return cls(name, folder, run.task, open_run(policy).tracker if policy else run.tracker, owner)

    @property
    def policy(self) -> PolicyBundle:
        return self.tracker.policy

    @property
    def mark(self) -> str:
        """A hash of the policy's numbers, by which results are known to be its own."""
        digest = hashlib.sha256()
        for key, value in sorted(self.policy.state().items()):
            digest.update(key.encode() + value.contiguous().cpu().numpy().tobytes())
        return digest.hexdigest()[:16]

    def about(self, hardware: str) -> dict[str, Any]:
        """What the training was: data, settings, samples, time, hardware."""
        library, about, config = self.imitation.library, self.tracker.about, self.imitation.config
        body = self.imitation.humanoid
        return {
            "folder": self.folder.name, "method": config.method, "policy": self.mark,
            "clips": len(library), "minutes_of_motion": round(library.seconds / 60, 2),
            "subjects": subjects(library.names), "clip_names": list(library.names),
            "stage": about["stage"], "finished": about["finished"], "help_n": about["help_n"],
            "samples": about["samples"], "seconds": round(about["seconds"], 1),
            "hardware": hardware or "not recorded",
            "primitives": _columns(self.policy), "policy_numbers": _numbers(self.policy),
            "config": to_data(config),
            "body": {
                "bodies": len(body.bodies), "hinges": len(body.hinges),
                "mass_kg": round(body.mass, 1), "height_m": round(body.table.height_m, 2),
                "identity": body.identity,
            },
        }  # fmt: skip


def subjects(names: Sequence[str]) -> list[str]:
    """The performers of these clips."""
    return sorted({subject_of(n) for n in names})


def _columns(policy: PolicyBundle) -> int:
    return int(policy.shape.get("columns", 0))


def _numbers(policy: PolicyBundle) -> int:
    return sum(p.numel() for p in policy.policy.parameters())


# --- clips that were held out -------------------------------------------------------------------


def held_out(
    run: Run, folder: Path, patterns: Sequence[str], never: Sequence[str], cache: Path | None, tell: Tell
) -> tuple[ClipLibrary, list[str]]:
    """Clips of a folder on the run's skeleton that it did not learn from, and sentences on them.

    patterns: subjects or regular expressions, see `perpetual_data.split`; without any, whatever was not
    learned.

    Raises:
        PoiseError: one that a pattern asks for was learned, or none is left.
    """
    config = LibraryConfig(leave_out=tuple(never))
    library, report = library_of(
        folder, run.tracker.example, run.imitation.config.sim.control_hz, config=config,
        body=run.imitation.config.body, cache=cache, tell=tell,
    )  # fmt: skip
    clips = [c for c in library if not patterns or matches(tuple(patterns), c.name, subject_of(c.name))]
    seen = {c.name: twin for c in clips if (twin := _learned(run, c)) is not None}
    if patterns and seen:
        name, twin = next(iter(seen.items()))
        raise PoiseError(
            f"'{name}' was learned, as '{twin}'; it cannot be held out", folder, code="clip-was-learned"
        )
    clips = [c for c in clips if c.name not in seen]
    if not clips:
        raise PoiseError("holds no clip that was held out of the training", folder, code="none-held-out")
    both = sorted({*subjects([c.name for c in clips])} & {*subjects(run.imitation.library.names)})
    notes = list(report.sentences())
    if both:
        notes.append(f"Subjects with clips on both sides: {', '.join(both)}.")
    return ClipLibrary.of(clips), notes


def _learned(run: Run, clip: Clip) -> str | None:
    """Which clip of the training this one is, by its name or by its motion."""
    library = run.imitation.library
    if clip.name in library.names:
        return clip.name
    return next((c.name for c in library if _same(c, clip)), None)


def _same(a: Clip, b: Clip) -> bool:
    if a.rot.shape != b.rot.shape:
        return False
    # q and -q are one rotation.
    apart = np.minimum(np.abs(a.rot - b.rot).max(-1), np.abs(a.rot + b.rot).max(-1))
    return bool(apart.max() < SAME)


def library_task(run: Run, clips: ClipLibrary) -> Imitation:
    """Clips as a task on the run's own body; they do not change its joint ranges."""
    return imitation_of(run.tracker, [place(c, run.tracker) for c in clips])


def recorded(names: Sequence[str]) -> tuple[list[int], list[int]]:
    """Indices of clips as they were recorded, and of those that were made of them."""
    made = [i for i, n in enumerate(names) if n.endswith((MIRRORED, BACKWARDS))]
    return [i for i in range(len(names)) if i not in set(made)], made


# --- (a) the field's table ----------------------------------------------------------------------


def table(
    task: Imitation,
    policy: Acts,
    data: str,
    method: str,
    threads: int,
    clips: Sequence[int] | None = None,
) -> FieldTable:
    """Every clip, or those of these indices, from its first frame, without help."""
    length, at_once = task.reference.length, []
    wanted = set(range(len(length)) if clips is None else clips)
    order, rows, longest = length.argsort(stable=True).tolist(), [], 0
    order = [c for c in order if c in wanted]
    for c in order:
        longest = int(length[c])
        if rows and (len(rows) + 1) * longest > AT_ONCE:
            at_once.append(rows)
            rows = []
        rows.append(c)
    parts = [*at_once, rows]

    def rollouts() -> Iterator[RolloutSet]:
        for part in parts:
            clip = torch.tensor(part)
            yield run_episodes(make, policy, clip, torch.zeros_like(clip), cycles=1)[0]

    def make(worlds: int) -> ImitationEnv:
        # A world that goes bad after its character was lost is no reason to stop.
        return task.bare().env(worlds, None, False, threads, help_scale=0.0, guard=False)

    return field_table(rollouts(), method=method, data=data)


def by_body(task: Imitation, whole: FieldTable) -> list[dict[str, Any]]:
    """The same table body by body, where a library was learned on several; else nothing."""
    reference, rows = task.reference, {c.clip: c for c in whole.clips}
    if len(reference.bodies) == 1:
        return []
    out = []
    for k, humanoid in enumerate(reference.bodies):
        own = [rows[n] for n, b in zip(reference.names, reference.body.tolist(), strict=True) if b == k]
        frames = sum(c.frames for c in own)
        error = sum(c.frames * c.errors.g_mpjpe for c in own if c.frames)
        out.append({
            "body": k, "mass_kg": round(humanoid.mass, 1),
            "height_m": round(humanoid.table.height_m, 2), "clips": len(own),
            "succ": sum(not c.failed for c in own) / len(own) if own else None,
            "g_mpjpe": round(error / frames, 2) if frames else None,
        })  # fmt: skip
    return out


# --- (b) recovery -------------------------------------------------------------------------------


def recovery(run: Run, kind: str, trials: int, threads: int) -> dict[str, Any]:
    """Trials of one of the fail-states against a body that stands at ease."""
    humanoid, config = run.imitation.humanoid, run.imitation.config
    still = np.tile(relaxed_stance(humanoid).qpos, (30, 1))
    reference = Reference(humanoid, [still], config.sim.control_hz, ["standing at ease"])
    recovery_clips = run.imitation.recovery_clips
    task = trial_task(run.imitation.task, falls=trials, guided=recovery_clips is not None)

    def make(worlds: int) -> ImitationEnv:
        tried = replace(run.imitation, reference=reference, task=task)
        return tried.env(worlds, None, False, threads, help_scale=0.0, guard=False)

    card = recovery_card(
        make, run.policy, trials, method=run.name, kinds=(kind,), recovery_clips=recovery_clips
    )
    learned = recovery_clips is not None or run.imitation.task.recovery is not None
    return card.to_dict() | {"learned": learned, "ways": recovery_clips is not None}


def recovery_kinds() -> tuple[str, ...]:
    """The fail-states of the paper's table."""
    return tuple(KINDS)


# --- (c) composer against primitives ------------------------------------------------------------


def owners(run: Run, threads: int) -> dict[str, Any]:
    """The composer beside every primitive on every clip that was learned; which one owns which clip."""
    if not isinstance(run.policy.policy, Composer) or run.owner is None:
        return {"skipped": "the policy is no composer of primitives"}
    names, task = run.imitation.library.names, run.imitation
    parts: list[ClipResults] = []
    for k in range(_columns(run.policy)):
        # As it was when its stage ended; that of recovery, which owns no clip, is only in the composer.
        path = run.folder / f"primitive-{k + 1}.safetensors"
        kept = path.exists()
        own = load_policy(path, task.humanoid.identity) if kept else primitive(run.policy, k)
        parts.append(evaluate_clips(task, own, threads=threads))
    whole = evaluate_clips(task, run.policy, threads=threads)
    rows = []
    for c, name in enumerate(names):
        k = int(run.owner[c])
        tried = [
            (bool(p.succeeded[c]), -round(float(p.global_mm[c]), 2), -j) for j, p in enumerate(parts)
        ]
        won, less, j = max(tried)
        own, all_ = parts[k], whole
        rows.append({
            "clip": name, "owner": k + 1, "owner_succeeded": bool(own.succeeded[c]),
            "owner_mm": round(float(own.global_mm[c]), 2), "best": 1 - j, "best_succeeded": won,
            "best_mm": -less, "composer_succeeded": bool(all_.succeeded[c]),
            "composer_mm": round(float(all_.global_mm[c]), 2),
        })  # fmt: skip
    return {"per_clip": rows, "summary": owner_summary(rows)}


def owner_summary(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Per primitive: the clips that it owns, how many it does, how many of these the composer loses.

    worse_mm, worse_best_mm: mean of the composer's error less the owner's (the best primitive's), over
    clips that both do; None without any.
    """
    out = []
    for k in sorted({r["owner"] for r in rows}):
        own = [r for r in rows if r["owner"] == k]
        both = [r for r in own if r["owner_succeeded"] and r["composer_succeeded"]]
        best = [r for r in own if r["best_succeeded"] and r["composer_succeeded"]]
        out.append({
            "primitive": k, "clips": len(own),
            "owner": sum(r["owner_succeeded"] for r in own),
            "best": sum(r["best_succeeded"] for r in own),
            "composer": sum(r["composer_succeeded"] for r in own),
            "lost": [r["clip"] for r in own if r["owner_succeeded"] and not r["composer_succeeded"]],
            "worse_mm": _mean([r["composer_mm"] - r["owner_mm"] for r in both]),
            "worse_best_mm": _mean([r["composer_mm"] - r["best_mm"] for r in best]),
        })  # fmt: skip
    return out


def _mean(values: Sequence[float]) -> float | None:
    return round(statistics.fmean(values), 2) if values else None
