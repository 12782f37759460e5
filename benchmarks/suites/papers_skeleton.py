"""Skeleton2Humanoid's Tables 1 and 4 in spirit: transitions of a length, corrected stage by stage.

Each window is 10 recorded frames of Bandai's, a transition, and 5 recorded frames; the in-betweening
network that comes with Poise, which has learned none of them, makes the transition. Policies are trained
on the very motions that they correct, as in the paper; that of poise track is not. The analytic inverse
kinematics see places of joints alone; what policies correct has the clips' own angles and is set on the
floor. FP and FQ are of soles, not of joint centres, which lie above the floor in these clips: FQ is the
share of feet more than 5 mm below it. Help stands beside every row; "base" is the null, which nothing
corrects.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks.common.clips import WALK, Places
from benchmarks.common.policies import stated
from benchmarks.common.rows import Figure, of
from benchmarks.common.runner import Part, Raws
from poise.env import Reference
from poise.formats import read_clip
from poise.jobs.inbetween.fill import inbetween
from poise.jobs.open import open_run
from poise.jobs.runs import begin, evaluate, train, trained_policy
from poise.jobs.track import track
from poise.kinematics import IkBody, clip_ik, fit_humanoid
from poise.kinematics.forward import lowest_height
from poise.learn import Until
from poise.metrics import l2p
from poise.motion import Clip, ClipLibrary, shifted, trim
from poise.motion.rotations import forward_kinematics
from poise.papers.compliant.scene_training import digest_of
from poise.papers.skeleton2humanoid.recipe import Budget, build, settings
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force_settings import ResidualForce
from poise.score.gaps import BANDAI, deviation
from poise.synthesis.windows import pack_frames

PAST, AFTER, FPS = 10, 5, 30.0


VARIANTS = ("uhc", "one frame", "no curriculum", "full", "full to zero")


#: m below the floor from which a sole counts as through it.
THROUGH = 0.005


class Motion(NamedTuple):
    """Bodies of N windows: `pos (N, T, B, 3)` m and `quat (N, T, B, 4)`."""

    pos: Tensor
    quat: Tensor


class Set(NamedTuple):
    """Windows as recorded, on the floor, and L2P's deviation by joint."""

    truth: list[Clip]
    std: dict[str, Tensor]


def windows(data: Path, length: int, count: int) -> Set:
    """As many windows, evenly spread over the clips; none of the styles held out for final figures."""
    files = sorted((data / "other" / "bandai_bvh").glob("*.bvh"))
    kept = [f for f in files if not re.search(BANDAI.final, f.name)]
    clips = [read_clip(f) for f in kept]
    need = PAST + length + AFTER
    usable = [c for c in clips if c.frames >= need + 10 and c.skeleton.same_bones(clips[0].skeleton)]
    bank = pack_frames(usable, FPS)
    std = dict(zip(bank.names, deviation(bank, BANDAI), strict=True))
    picks = [usable[round(i * (len(usable) - 1) / (count - 1))] for i in range(count)]
    out = []
    for clip in picks:
        first = min(clip.frames // 3, clip.frames - need)
        own = trim(clip, first, first + need - 1)
        *_, report = fit_humanoid(ClipLibrary.of([clip]), ResidualForce().body, FPS)
        out.append(shifted(own, (0.0, 0.0, report.clips[0].ground.lift_m)))
    return Set(out, std)


def filled(truth: list[Clip], length: int, adapt: int) -> list[Clip]:
    """The transitions as the network makes them, nothing mended."""
    keys = (PAST - 1, PAST + length)
    return [inbetween(c, keys, adapt=adapt, foot_lock=False).clip for c in truth]


def on_joints(clips: list[Clip], joints: list[int]) -> Motion:
    """Some joints of clips, as they lie in the world."""
    parts = []
    for c in clips:
        offsets, root = torch.tensor(c.skeleton.offsets), torch.tensor(c.root_pos)
        parts.append(forward_kinematics(c.skeleton.parents, offsets, root, torch.tensor(c.rot)))
    pos, quat = (torch.stack(x)[:, :, joints] for x in zip(*parts, strict=True))
    return Motion(pos, quat)


def figures(made: Motion, truth: Motion, task: Imitation, std: Tensor, length: int) -> dict[str, float]:
    """FP, FQ, JQ, SM and L2P of the transitions."""
    rows = slice(PAST, PAST + length)
    low = lowest_height(task.humanoid.table, made.pos.double(), made.quat.double())[:, rows]
    feet = low[..., list(task.humanoid.feet)]
    moved = torch.diff(made.pos[:, PAST - 1 : PAST + length + 1], dim=1).norm(dim=-1)
    return {
        "fp_mm": round(float(1000 * feet.clamp_max(0.0).mean()), 3),
        "fq_percent": round(100 * float((feet < -THROUGH).double().mean()), 2),
        "jq_percent": round(100 * float((low < -THROUGH).double().mean()), 2),
        "sm_mm": round(float(1000 * moved.mean()), 2),
        "l2p": round(float(l2p(made.pos[:, rows].double(), truth.pos[:, rows].double(), std)), 4),
    }


def by_joints(clips: list[Clip], task: Imitation) -> Motion:
    """The body as the analytic inverse kinematics pose it from the places of the clips' joints."""
    body, names = IkBody.of(task.humanoid), [c.name for c in clips]
    posed = Reference(task.humanoid, [clip_ik(c, body) for c in clips], FPS, names).pose
    return Motion(*(x.unflatten(0, (len(clips), -1)) for x in (posed.pos, posed.quat)))


def policy_row(
    task: Imitation, folder: Path, iterations: int, truth: Motion, std: Tensor, length: int
) -> dict[str, Any]:
    """A policy trained on the windows, and its figures from each one's first frame."""
    begun = time.perf_counter()

    def told(stats: Any) -> None:
        if round(stats.iteration) % 20 == 0:
            print(f"{folder.name}: {stats.iteration} of {iterations}, {stats.reward:.3f}", flush=True)

    train(task, folder, Until(iterations=iterations), told, threads=1, tensorboard=False)
    policy, meta = trained_policy(folder, task)
    every = torch.arange(len(task.library.clips))
    result = evaluate(task, policy, meta, starts=(every, torch.zeros_like(every)))
    r, card = result.rollouts, result.card
    return {
        **figures(Motion(r.pos, r.quat), truth, task, std, length),
        "succ": round(card.succ, 4),
        "mpjpe_mm": round(card.mpjpe_mm, 2),
        "mpjpe_global_mm": round(card.mpjpe_global_mm, 2),
        "limit_n": round(float(meta["help_limit"]), 1),
        "force_mean_n": round(card.help.force_mean_n, 2),
        "torque_mean_nm": round(card.help.torque_mean_nm, 2),
        "samples": int(meta["samples"]),
        "minutes": round((time.perf_counter() - begun) / 60, 1),
    }


def tracked_row(
    clips: list[Clip], joints: list[int], task: Imitation, truth: Motion, std: Tensor, length: int
) -> dict[str, Any]:
    """The policy that comes with Poise, with lookahead, on the same motions; no help."""
    run, begun = open_run(None), time.perf_counter()
    done = [track(c, run, threads=1, supports="none") for c in clips]
    took = time.perf_counter() - begun
    frames = clips[0].frames
    # On the floor that it was simulated on: what is written is as high as the source again.
    made = on_joints([trim(d.at_home(d.motion(), False), 0, frames - 1) for d in done], joints)
    return {
        **figures(made, truth, task, std, length),
        "succ": sum(not d.failures for d in done) / len(done),
        "mpjpe_mm": round(sum(d.card.mpjpe_mm for d in done) / len(done), 2),
        "mpjpe_global_mm": round(sum(d.card.mpjpe_global_mm for d in done) / len(done), 2),
        "force_mean_n": 0.0,
        "torque_mean_nm": 0.0,
        "samples": 0,
        "minutes": round(took / 60, 1),
        "policy": digest_of(run.tracker.policy),
    }


COUNT, ITERATIONS = 32, 60
LENGTHS = (5, 15, 30)
KINEMATIC = ("recorded", "base", "base + TTA", "base + TTA + IK", "base + TTA + set on the floor")
LOOKS = "base + TTA + universal policy with lookahead"


class Bench(NamedTuple):
    """Fields that the rows of a length share."""

    test: Set
    adapted: list[Clip]
    task: Imitation
    joints: list[int]
    std: Tensor
    truth: Motion


@cache
def bench(places: Places, length: int) -> Bench:
    """Windows, transitions after adaptation, and the task on them."""
    test = toys(length) if places.smoke else windows(places.data, length, COUNT)
    adapted = filled(test.truth, length, 1 if places.smoke else 20)
    task = build(ClipLibrary.of(adapted), settings("full", budget(places)))
    joints = [r.joint for r in task.humanoid.table.rows]
    names = task.humanoid.skeleton.names
    std = torch.stack([test.std[names[j]] for j in joints])
    return Bench(test, adapted, task, joints, std, on_joints(test.truth, joints))


def toys(length: int) -> Set:
    """Two windows of the walk, for a smoke test."""
    clip = read_clip(WALK)
    cut = [trim(clip, k, k + PAST + length + AFTER - 1) for k in (0, 5)]
    return Set(cut, {n: torch.ones(3, dtype=torch.float64) for n in clip.skeleton.names})


def budget(places: Places) -> Budget:
    """How long a policy is trained."""
    return Budget(8, 4, 1) if places.smoke else Budget(iterations=ITERATIONS)


def units(places: Places) -> list[str]:
    """Lengths and stages."""
    if places.smoke:
        return [f"5 frames; {k}" for k in ("recorded", "base", "full, seed 0")]
    rows = [f"{n} frames; {k}" for n in LENGTHS for k in (*KINEMATIC, LOOKS)]
    return rows + [f"{n} frames; {v}, seed {s}" for n in LENGTHS for v in VARIANTS for s in (0, 1)]


def corrected(places: Places, unit: str) -> Any:
    """One stage."""
    what, _, kind = unit.partition("; ")
    n = int(what.split()[0])
    b = bench(places, n)
    variant, _, seed = kind.partition(", seed ")
    if seed:
        own = settings(variant, budget(places), seed=int(seed))
        if places.smoke:
            own = replace(
                own, ppo=replace(own.ppo, minibatch=16, norm_warmup=2, policy_hidden=(8,)), expert=False
            )
        folder = places.work / "s2h" / f"{n}-{variant.replace(' ', '-')}-{seed}"
        task = begin(folder, ClipLibrary.of(b.adapted), own)
        return policy_row(task, folder, budget(places).iterations, b.truth, b.std, n)
    if kind == LOOKS:
        return tracked_row(b.adapted, b.joints, b.task, b.truth, b.std, n)
    pose, many = b.task.reference.pose, len(b.test.truth)
    made: dict[str, Callable[[], Motion]] = {
        "recorded": lambda: b.truth,
        "base": lambda: on_joints(filled(b.test.truth, n, 0), b.joints),
        "base + TTA": lambda: on_joints(b.adapted, b.joints),
        "base + TTA + IK": lambda: by_joints(b.adapted, b.task),
        "base + TTA + set on the floor": lambda: Motion(
            *(x.unflatten(0, (many, -1)) for x in (pose.pos, pose.quat))
        ),
    }
    return figures(made[kind](), b.truth, b.task, b.std, n)


def rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Each stage."""
    for unit, raw in raws.items():
        kind = unit.partition("; ")[2]
        policy = stated(("inbetween",)) if "base" in kind else ""
        policy = stated(("inbetween", "tracker")) if kind == LOOKS else policy
        if ", seed " in kind:
            policy = f"{kind.partition(',')[0]} (trained for this table)"
        values = {k: v for k, v in raw.items() if k not in ("samples", "minutes", "policy")}
        yield from of(f"Skeleton2Humanoid, {unit}", values, 2 if places.smoke else COUNT, policy=policy)


PARTS = {"skeleton": Part("Skeleton2Humanoid, Tables 1 and 4", units, corrected, rows, hours=6.0)}
