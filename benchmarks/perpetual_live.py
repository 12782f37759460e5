"""What `perpetual.py` measures of a policy in use: noisy input, estimators' files, real time."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from field.table import field_table
from perpetual_measure import Run, Tell, library_task
from speed import bench_latency, machine

from poise.errors import PoiseError
from poise.formats import read_clip
from poise.formats.raw import ReadOptions as Stated
from poise.jobs.library.files import motion_files_of
from poise.jobs.track import TrackConfig, side_by_side, track
from poise.jobs.track.noise import robustness
from poise.jobs.track.placement import points_of
from poise.jobs.track.supports import crowd as in_one_world
from poise.motion import ClipLibrary
from poise.motion.noise import robustness_levels


def noise(
    run: Run, clips: ClipLibrary, most: int, strengths: Sequence[float], each: bool, tell: Tell
) -> dict[str, Any]:
    """Success over the strength of a video estimator's noise, on clips spread evenly over `clips`."""
    count = min(most, len(clips))
    picks = [clips.clips[k * len(clips) // count] for k in range(count)]
    levels = robustness_levels(strengths=tuple(strengths), each=each)
    result = robustness(run.tracker, picks, levels, tell=tell)
    return result.to_dict() | {"clips": [c.name for c in picks]}


def noisy(run: Run, folders: Sequence[Path], tell: Tell) -> dict[str, Any]:
    """The estimators' own files tracked as they are: the field's table against what came in."""
    parts, rows, refused = [], [], []
    for file in (f for folder in folders for f in motion_files_of(folder)):
        try:
            clip = read_clip(file.path)
            done = track(
                points_of(clip, Stated()) or clip, run.tracker, TrackConfig(controller="policy")
            )
        except PoiseError as problem:
            refused.append({"file": file.name, "why": problem.what})
            continue
        parts.append(done.evaluation.rollouts)
        first = round(done.failed_s[0], 2) if done.failed_s else None
        rows.append({"file": file.name, "failed_s": first})
        tell(f"{file.name}: " + ("tracked" if first is None else f"failed at {first:.1f} s"))
    if not parts:
        return {"skipped": "no file could be tracked", "refused": refused}
    card = field_table(parts, method=run.name, data="noisy set")
    return {"table": card.to_dict(), "files": rows, "refused": refused}


def speed(run: Run, steps: int, count: int) -> dict[str, Any]:
    """One character on one thread, and `count` in one world on one and on two, without help."""
    return {
        "machine": machine(),
        "one": bench_latency(run.imitation, run.policy, steps),
        "crowds": [crowd(run, steps, *how) for how in ((1, 1), (count, 1), (count, 2))],
    }


def crowd(run: Run, steps: int, count: int, threads: int) -> dict[str, Any]:
    """Control steps of `count` characters that share a world, policy and terms on `threads` threads.

    "ms" is the median of the time that passed, "cpu_ms" the mean of the processor's time of all threads,
    which other programs on the machine hardly change.
    """
    longest = max(run.imitation.library, key=lambda c: c.seconds)
    task = library_task(run, ClipLibrary.of(longest))
    if count > 1:
        task = side_by_side(task, count)
    before = torch.get_num_threads()
    backend = in_one_world(task.humanoid, task.config.sim, count)
    env = task.env(auto_reset=False, help_scale=0.0, guard=False, backend=backend)
    torch.set_num_threads(threads)
    clip, zero = torch.arange(count), torch.zeros(count, dtype=torch.long)
    last, spent, worked = int(task.reference.length[0]) - 1, [], 0.0
    try:
        obs = env.reset_to(clip, zero)
        for k in range(steps + 20):
            if int(env.frame[0]) >= last:
                obs = env.reset_to(clip, zero)
            start, work = time.perf_counter(), time.process_time()
            obs = env.step(run.policy.act(obs)).obs
            # The first steps make buffers and recordings.
            if k >= 20:
                spent.append(time.perf_counter() - start)
                worked += time.process_time() - work
    finally:
        torch.set_num_threads(before)
        env.close()
    middle, slow = statistics.median(spent), sorted(spent)[int(0.95 * len(spent))]
    return {
        "characters": count, "threads": threads, "steps": steps, "ms": round(1e3 * middle, 3),
        "ms_95": round(1e3 * slow, 3), "cpu_ms": round(1e3 * worked / steps, 3),
        "hz": round(1 / middle, 1), "hz_95": round(1 / slow, 1),
    }  # fmt: skip
