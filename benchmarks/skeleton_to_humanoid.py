"""Skeleton2Humanoid's Tables 1 and 4 in spirit: transitions of a length, corrected stage by stage.

    python benchmarks/skeleton_to_humanoid.py --data DIR --work DIR -o FILE.json [--length 30]
        [--variants full uhc] [--seeds 0 1] [--iterations 120] [--count 32]

DIR holds Bandai's motions (`other/bandai_bvh`). Each window is 10 recorded frames, a transition, and 5
recorded frames; the in-betweening network that comes with Poise, which has learned none of them, makes
the transition. Policies are trained on the very motions that they correct, as in the paper; that of
poise track is not. The analytic inverse kinematics see places of joints alone; what policies correct has
the clips' own angles and is set on the floor. FP and FQ are of soles, not of joint centres, which lie
above the floor in these clips: FQ is the share of feet more than 5 mm below it. Help stands beside every
row. Resumable.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

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
from poise.motion.windows import pack_frames
from poise.papers.compliant.scene_training import digest_of
from poise.papers.skeleton2humanoid.recipe import Budget, build, settings
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force import ResidualForce
from poise.score.gaps import BANDAI, deviation

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
    }  # fmt: skip


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
        "succ": round(card.succ, 4), "mpjpe_mm": round(card.mpjpe_mm, 2),
        "mpjpe_global_mm": round(card.mpjpe_global_mm, 2),
        "limit_n": round(float(meta["help_limit"]), 1),
        "force_mean_n": round(card.help.force_mean_n, 2),
        "torque_mean_nm": round(card.help.torque_mean_nm, 2),
        "samples": int(meta["samples"]), "minutes": round((time.perf_counter() - begun) / 60, 1),
    }  # fmt: skip


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
        "force_mean_n": 0.0, "torque_mean_nm": 0.0, "samples": 0, "minutes": round(took / 60, 1),
        "policy": digest_of(run.tracker.policy),
    }  # fmt: skip


def main() -> None:
    """Every stage, row by row; what FILE holds already stays."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--length", type=int, default=30)
    parser.add_argument("--count", type=int, default=32)
    parser.add_argument("--iterations", type=int, default=120)
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS))
    parser.add_argument("--seeds", type=int, nargs="*", default=[0])
    parser.add_argument("-o", type=Path, required=True)
    args = parser.parse_args()
    torch.set_num_threads(1)
    found: dict[str, Any] = json.loads(args.o.read_text()) if args.o.exists() else {}
    name, n = str(args.length), args.length
    rows: dict[str, Any] = found.setdefault(name, {})
    test = windows(args.data, n, args.count)
    budget = Budget(iterations=args.iterations)
    adapted = filled(test.truth, n, 20)
    task = build(ClipLibrary.of(adapted), settings("full", budget))
    joints = [r.joint for r in task.humanoid.table.rows]
    names = task.humanoid.skeleton.names
    std = torch.stack([test.std[names[j]] for j in joints])
    truth = on_joints(test.truth, joints)

    def keep(key: str, row: dict[str, Any]) -> None:
        rows[key] = row
        how = f"--length {n} --count {args.count} --iterations {args.iterations}"
        found["command"] = (
            f"python benchmarks/skeleton_to_humanoid.py --data DIR --work DIR -o FILE.json {how}"
        )
        args.o.write_text(json.dumps(found, indent=1) + "\n")
        print(key, json.dumps(row), file=sys.stderr, flush=True)

    def kinematic(key: str, made: Motion) -> None:
        if key not in rows:
            keep(key, figures(made, truth, task, std, n))

    kinematic("recorded", truth)
    kinematic("base", on_joints(filled(test.truth, n, 0), joints))
    kinematic("base + TTA", on_joints(adapted, joints))
    kinematic("base + TTA + IK", by_joints(adapted, task))
    pose, many = task.reference.pose, len(test.truth)
    floor = Motion(*(x.unflatten(0, (many, -1)) for x in (pose.pos, pose.quat)))
    kinematic("base + TTA + set on the floor", floor)
    key = "base + TTA + universal policy with lookahead"
    if key not in rows:
        keep(key, tracked_row(adapted, joints, task, truth, std, n))
    for seed in args.seeds:
        for variant in args.variants:
            if f"{variant}, seed {seed}" in rows:
                continue
            config = settings(variant, budget, seed=seed)
            folder = args.work / f"{n}-{variant.replace(' ', '-')}-{seed}"
            own = begin(folder, ClipLibrary.of(adapted), config)
            row = policy_row(own, folder, args.iterations, truth, std, n)
            keep(f"{variant}, seed {seed}", row)


if __name__ == "__main__":
    main()
