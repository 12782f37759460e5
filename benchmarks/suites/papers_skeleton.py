"""Skeleton2Humanoid's Tables 1 and 4 in spirit: transitions of a length, corrected stage by stage.

Each window is 10 recorded frames of Bandai's, a transition, and 5 recorded frames; the in-betweening
network that comes with Poise, which has learned none of them, makes the transition. Policies are trained
on the very motions that they correct, as in the paper; that of poise track is not. The analytic inverse
kinematics see places of joints alone; policies correct what they give, set on the floor, and rows of
their own leave out the adaptation, the inverse kinematics or the floor. FP and FQ are of soles, not of
joint centres, which lie above the floor in these clips: FQ is the share of feet more than 5 mm below it.
L2P is from the recording set on the floor. Help stands beside every row; "base" is the null, which
nothing corrects. Errors are standard errors over the windows, each the mean of its seeds.

Places alone also come in from keypoints: there the rotations of the analytic inverse kinematics stand
beside those of the fit that reads them.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks.common.clips import WALK, Places
from benchmarks.common.policies import stated
from benchmarks.common.rows import Figure, mean_of, of
from benchmarks.common.runner import Part, Raws
from poise.body import Humanoid, generate_table
from poise.env import Reference
from poise.formats import read_clip
from poise.formats.landmarks import complete
from poise.formats.point_fit import JOINT_PLACES, FitConfig, bones_of, fit_clip
from poise.formats.point_skeleton import hold_lengths, measure, trunk_tracks
from poise.jobs.inbetween.fill import inbetween
from poise.jobs.open import open_run, policy_of_run
from poise.jobs.perpetual.perpetual_run import begin as begin_library
from poise.jobs.perpetual.perpetual_run import train as train_library
from poise.jobs.perpetual.stages import Progress
from poise.jobs.run_file import read_run
from poise.jobs.runs import begin, evaluate, train, trained_policy
from poise.jobs.track import TrackConfig, track
from poise.jobs.track.learning import helped
from poise.jobs.track.learning import settings as learning
from poise.jobs.track.placement import place
from poise.jobs.track.tracking import with_guide
from poise.jobs.tracker import Tracker
from poise.jobs.warm_start import widened
from poise.kinematics import IkBody, analytic_ik, clip_ik, fit_humanoid, ik_body, qpos_to_clip
from poise.kinematics.forward import lowest_height, shapes_of
from poise.learn import LATEST, Until
from poise.metrics import foot_points, foot_slide, l2p, l2q
from poise.motion import Clip, ClipLibrary, resample, shifted, trim
from poise.motion.keypoints import Keypoints
from poise.motion.roles import find_roles
from poise.motion.rotations import forward_kinematics, quat_between, quat_to_rotvec
from poise.motion.skeleton import Source
from poise.papers.compliant.scene_training import digest_of
from poise.papers.skeleton2humanoid.recipe import Budget, as_came, build, posed, settings
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


def figures(
    made: Motion, truth: Motion, task: Imitation, std: Tensor, length: int
) -> dict[str, list[float]]:
    """FP, FQ, JQ, SM, L2P and slide of each transition."""
    rows = slice(PAST, PAST + length)
    moved = torch.diff(made.pos[:, PAST - 1 : PAST + length + 1], dim=1).norm(dim=-1)
    pairs = zip(made.pos[:, rows].double(), truth.pos[:, rows].double(), strict=True)
    return {
        **on_floor(made, task.humanoid, length),
        "sm_mm": rounded(1000 * moved.mean((-2, -1))),
        "l2p": rounded(torch.stack([l2p(m, t, std) for m, t in pairs])),
    }


def on_floor(made: Motion, humanoid: Humanoid, length: int) -> dict[str, list[float]]:
    """FP, FQ, JQ and slide of each transition."""
    rows = slice(PAST, PAST + length)
    pos, quat, feet = made.pos[:, rows], made.quat[:, rows], list(humanoid.feet)
    low = lowest_height(humanoid.table, pos.double(), quat.double())
    points = foot_points(pos, quat, shapes_of(humanoid.table), feet)
    return {
        "fp_mm": rounded(1000 * low[..., feet].clamp_max(0.0).mean((-2, -1))),
        "fq_percent": rounded(100 * (low[..., feet] < -THROUGH).double().mean((-2, -1))),
        "jq_percent": rounded(100 * (low < -THROUGH).double().mean((-2, -1))),
        "slide_mm_per_s": rounded(torch.as_tensor(foot_slide(points, FPS))),
    }


def rounded(values: Tensor) -> list[float]:
    """Numbers with four digits after the point."""
    return [round(float(x), 4) for x in values]


def of_reference(reference: Reference) -> Motion:
    """The motions of a task, which are as long as each other."""
    count = len(reference.length)
    return Motion(*(x.unflatten(0, (count, -1)) for x in (reference.pose.pos, reference.pose.quat)))


def twin(clips: list[Clip], task: Imitation) -> Motion:
    """The body as the analytic inverse kinematics pose it, without the recipe."""
    body, names = IkBody.of(task.humanoid), [c.name for c in clips]
    return of_reference(Reference(task.humanoid, [clip_ik(c, body) for c in clips], FPS, names))


def apart_mm(a: Motion, b: Motion) -> dict[str, float]:
    """How far bodies of the same motions are from each other."""
    off = 1000 * (a.pos - b.pos).norm(dim=-1)
    return {"mean_mm": round(float(off.mean()), 4), "worst_mm": round(float(off.max()), 4)}


def policy_row(
    task: Imitation, folder: Path, iterations: int, truth: Motion, std: Tensor, length: int
) -> dict[str, Any]:
    """A policy trained on the windows, and its figures from each one's first frame."""

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
        "succ": [float(c["succ"]) for c in card.per_clip],
        "mpjpe_mm": [float(c["mpjpe_mm"]) for c in card.per_clip],
        "mpjpe_global_mm": [float(c["mpjpe_global_mm"]) for c in card.per_clip],
        "limit_n": round(float(meta["help_limit"]), 1),
        "force_mean_n": round(card.help.force_mean_n, 2),
        "torque_mean_nm": round(card.help.torque_mean_nm, 2),
        "samples": int(meta["samples"]),
    }


def tracked_row(
    clips: list[Clip], tracker: Tracker, b: Bench, length: int, own: bool = False
) -> dict[str, Any]:
    """A universal policy with lookahead on the same motions; no help.

    own: on the clips' own bones, so that soles are those of the body that was simulated.
    """
    done = [track(c, tracker, TrackConfig(threads=1, supports="none")) for c in clips]
    frames = clips[0].frames
    # On the floor that it was simulated on: what is written is as high as the source again.
    made = on_joints([trim(d.at_home(d.motion(), False), 0, frames - 1) for d in done], b.joints)
    found = figures(made, b.truth, b.task, b.std, length)
    if own:
        rolled = [d.evaluation.rollouts for d in done]
        parts = ([r.pos[0, :frames] for r in rolled], [r.quat[0, :frames] for r in rolled])
        found |= on_floor(Motion(*map(torch.stack, parts)), tracker.humanoid, length)
    return {
        **found,
        "succ": [float(not d.failures) for d in done],
        "mpjpe_mm": [d.card.mpjpe_mm for d in done],
        "mpjpe_global_mm": [d.card.mpjpe_global_mm for d in done],
        "force_mean_n": 0.0,
        "torque_mean_nm": 0.0,
    }


def learned_on(clips: list[Clip], folder: Path, samples: int, seed: int) -> Tracker:
    """The policy that ships, trained on the windows with a residual force that fades to none, on the
    windows' own bones."""
    tracker = open_run(None).tracker.with_bones_of(clips[0])
    placed = [place(c, tracker) for c in clips]
    config = helped(replace(learning(tracker.config, seed), num_envs=512), HELP_N)
    clips = [p.clip.replaced(name=f"{k}-{p.clip.name}", cyclic=False) for k, p in enumerate(placed)]
    task = begin_library(folder, ClipLibrary.of(clips), config, "windows", "cpu", tracker)
    motions, names = [p.qpos for p in placed], task.library.names
    reference = Reference(task.humanoid, motions, config.sim.control_hz, names)
    task = with_guide(replace(task, reference=reference))
    trained = None if (folder / LATEST).exists() else widened(tracker, task, 0)

    def told(progress: Progress) -> None:
        if progress.iteration % 20 == 0:
            print(f"{folder.name}: {progress.share:.0%}, {progress.succeeded} done", flush=True)

    train_library(task, folder, Until(samples=samples), told, 1, False, trained=trained)
    return replace(policy_of_run(read_run(folder)), onto=tracker.onto)


COUNT, ITERATIONS, SEEDS = 32, 60, (0, 1)
LENGTHS = (5, 15, 30)
TTA = 20
KINEMATIC = (
    "recorded",
    "recorded, set on the floor",
    "base",
    "base + TTA",
    "base + IK",
    "base + TTA + IK",
    "base + TTA + IK + set on the floor",
    "base + TTA + set on the floor",
    "base + set on the floor",
)
LOOKS = "base + TTA + universal policy with lookahead"
TWIN = "base + TTA + IK, beside kinematics.clip_ik"
#: The universal policy that goes on on the windows, N and N m of help that fades from there to none,
#: and control steps of each length.
ONWARD, HELP_N, ONWARD_SAMPLES = "from the tracker", 100.0, 1_000_000
#: Stages that a policy of all of them goes without, at the longest transition: iterations of
#: adaptation, the inverse kinematics, the floor.
WITHOUT: dict[str, tuple[int, bool, bool]] = {
    "full": (TTA, True, True),
    "full, without adaptation": (0, True, True),
    "full, without inverse kinematics": (TTA, False, True),
    "full, without the floor": (TTA, True, False),
}


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
    adapted = filled(test.truth, length, 1 if places.smoke else TTA)
    config = settings("full", budget(places))
    task = build(ClipLibrary.of(adapted), config)
    joints = [r.joint for r in task.humanoid.table.rows]
    names = task.humanoid.skeleton.names
    std = torch.stack([test.std[names[j]] for j in joints])
    truth = build(ClipLibrary.of(test.truth), config, analytic=False).reference
    return Bench(test, adapted, task, joints, std, of_reference(truth))


def toys(length: int) -> Set:
    """Two windows of the walk, for a smoke test."""
    clip = read_clip(WALK)
    cut = [trim(clip, k, k + PAST + length + AFTER - 1) for k in (0, 5)]
    return Set(cut, {n: torch.ones(3, dtype=torch.float64) for n in clip.skeleton.names})


def budget(places: Places) -> Budget:
    """How long a policy is trained."""
    return Budget(8, 4, 1) if places.smoke else Budget(iterations=ITERATIONS)


def units(places: Places) -> list[str]:
    """Lengths, policies and seeds, by what they tell."""
    if places.smoke:
        return [f"5 frames; {k}, seed 0" for k in ("full", "full, without the floor", ONWARD)]
    out = [f"{n} frames; {LOOKS}" for n in LENGTHS]
    table_4 = [v for v in VARIANTS if v not in ("full", "full to zero")]
    once = ["full to zero", *(v for v in WITHOUT if v != "full")]
    for s in SEEDS:
        out += [f"{n} frames; {v}, seed {s}" for v in (ONWARD, "full") for n in LENGTHS]
        out += [
            f"{LENGTHS[-1]} frames; {v}, seed {s}" for v in (*table_4, *(once if s == SEEDS[0] else ()))
        ]
    return out


def corrected(places: Places, unit: str) -> Any:
    """One policy."""
    what, _, kind = unit.partition("; ")
    n = int(what.split()[0])
    b = bench(places, n)
    if kind == LOOKS:
        tracker = open_run(None).tracker
        return tracked_row(b.adapted, tracker, b, n) | {"policy": digest_of(tracker.policy)}
    variant, _, seed = kind.partition(", seed ")
    folder = places.work / "s2h" / f"{n}-{re.sub('[^a-z]+', '-', variant)}-{seed}"
    if variant == ONWARD:
        asked = 64 if places.smoke else ONWARD_SAMPLES
        tracker = learned_on(b.adapted, folder, asked, int(seed))
        return tracked_row(b.adapted, tracker, b, n, own=True) | {"samples": asked}
    adapt, analytic, floor = WITHOUT.get(variant, WITHOUT["full"])
    own = settings("full" if variant in WITHOUT else variant, budget(places), seed=int(seed))  # type: ignore[arg-type]
    if places.smoke:
        own = replace(
            own, ppo=replace(own.ppo, minibatch=16, norm_warmup=2, policy_hidden=(8,)), expert=False
        )
    clips = ClipLibrary.of(b.adapted if adapt else filled(b.test.truth, n, 0))
    task = begin(folder, posed(clips) if analytic else clips, own)
    task = task if floor else as_came(task)
    return policy_row(task, folder, budget(places).iterations, b.truth, b.std, n)


def stage_units(places: Places) -> list[str]:
    """Lengths and stages without a policy."""
    return [f"{n} frames; {k}" for n in ((5,) if places.smoke else LENGTHS) for k in (*KINEMATIC, TWIN)]


def staged(places: Places, unit: str) -> Any:
    """One stage without a policy, through the recipe."""
    what, _, kind = unit.partition("; ")
    n = int(what.split()[0])
    b = bench(places, n)

    def converted(clips: list[Clip], **left_out: bool) -> Motion:
        return of_reference(build(ClipLibrary.of(clips), b.task.config, **left_out).reference)

    if kind == TWIN:
        high = as_came(b.task)
        return apart_mm(of_reference(high.reference), twin(b.adapted, high))
    made: dict[str, Callable[[], Motion]] = {
        "recorded": lambda: on_joints(b.test.truth, b.joints),
        "recorded, set on the floor": lambda: b.truth,
        "base": lambda: on_joints(filled(b.test.truth, n, 0), b.joints),
        "base + TTA": lambda: on_joints(b.adapted, b.joints),
        "base + IK": lambda: converted(filled(b.test.truth, n, 0), floor=False),
        "base + TTA + IK": lambda: of_reference(as_came(b.task).reference),
        "base + TTA + IK + set on the floor": lambda: of_reference(b.task.reference),
        "base + TTA + set on the floor": lambda: converted(b.adapted, analytic=False),
        "base + set on the floor": lambda: converted(filled(b.test.truth, n, 0), analytic=False),
    }
    return figures(made[kind](), b.truth, b.task, b.std, n)


#: Iterations of adaptation of Tables 5 and 6.
ITERATED = range(8)
#: Times that each is timed, of which the least counts.
DRAWS = 3


def iterated_units(places: Places) -> list[str]:
    """Lengths and iterations."""
    some = (5,) if places.smoke else LENGTHS
    return [
        f"{n} frames; {k} iterations" for n in some for k in (ITERATED[:2] if places.smoke else ITERATED)
    ]


def iterated(places: Places, unit: str) -> Any:
    """L2P and L2Q of each transition after so much adaptation, and ms of them all, each."""
    n, k = map(int, re.findall(r"\d+", unit))
    b = bench(places, n)
    filled(b.test.truth[:1], n, k)
    spent = list[float]()
    for _ in range(DRAWS):
        begun = time.process_time()
        made = on_joints(filled(b.test.truth, n, k), b.joints)
        spent.append(1000 * (time.process_time() - begun) / len(b.test.truth))
    truth, gap = on_joints(b.test.truth, b.joints), slice(PAST, PAST + n)
    pairs = [(m[gap], t[gap]) for m, t in zip(made.pos, truth.pos, strict=True)]
    # Both turns that are the same rotation count as one.
    same = (made.quat * truth.quat).sum(-1, keepdim=True) >= 0
    turned = torch.where(same, made.quat, -made.quat)
    turns = [(m[gap], t[gap]) for m, t in zip(turned, truth.quat, strict=True)]
    return {
        "l2p": [float(l2p(m.double(), t.double(), b.std)) for m, t in pairs],
        "l2q": [float(l2q(m, t)) for m, t in turns],
        "ms": min(spent),
    }


def iterated_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """By iterations, the metrics of each length; times of iterations are beyond the network's own."""
    policy = stated(("inbetween",))
    for unit, raw in raws.items():
        n, k = map(int, re.findall(r"\d+", unit))
        subject = "Skeleton2Humanoid, adaptation; " + (f"iteration {k}" if k else "baseline")
        for key in ("l2p", "l2q"):
            values = np.array(raw[key])
            error = f"+- {values.std(ddof=1) / math.sqrt(len(values)):.2g}"
            yield Figure(subject, f"{key}_{n}", values.mean(), len(values), error, policy=policy)
        ms = raw["ms"] - (raws[f"{n} frames; 0 iterations"]["ms"] if k else 0.0)
        yield Figure(subject, f"ms_{n}", ms, len(raw["l2p"]), policy=policy)


def rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Each stage: the mean of its windows with its standard error, a window the mean of its seeds."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for unit, raw in raws.items():
        groups.setdefault(unit.partition(", seed ")[0], []).append(raw)
    for unit, own in groups.items():
        kind = unit.partition("; ")[2]
        policy = stated(("inbetween",)) if "base" in kind else ""
        policy = stated(("inbetween", "tracker")) if kind == LOOKS else policy
        if "samples" in own[0]:
            policy = f"{kind} (trained for this table)"
        subject = f"Skeleton2Humanoid, {unit}"
        for key in own[0].keys() - {"policy"}:
            values = np.atleast_1d(np.mean([r[key] for r in own], axis=0))
            # Feet that never touch the floor do not slide.
            values = values[np.isfinite(values)]
            if not len(values):
                continue
            error = values.std(ddof=1) / math.sqrt(len(values)) if len(values) > 1 else None
            spread = "" if error is None else f"+- {error:.2g}"
            n = COUNT if error is None else len(values)
            yield Figure(subject, key, float(values.mean()), n, spread, len(own), policy)


# --- places alone -----------------------------------------------------------------------------------

#: mm of white noise in three directions together, and whether it is taken off first.
SEEN = ((0.0, False), (10.0, False), (10.0, True))
PLACES_SECONDS, PLACES_FPS = 10.0, 30.0
ROLES = {
    "hips": "pelvis",
    "spine": "spine",
    "neck": "neck",
    "head": "head",
    "clavicle": "collar",
    "upper_arm": "shoulder",
    "forearm": "elbow",
    "hand": "wrist",
    "thigh": "hip",
    "shin": "knee",
    "foot": "ankle",
    "toes": "toe",
}


def clips_of_places(places: Places) -> dict[str, Path]:
    """Five recordings of CMU's and five of Bandai's."""
    if places.smoke:
        return {"walk": WALK}
    sets = (
        sorted(places.data.glob("cmu_amc/*/*.amc")),
        sorted(places.data.glob("other/bandai_bvh/dataset-1_*normal*.bvh")),
    )
    picked = [f[round(i * (len(f) - 1) / 4)] for f in sets for i in range(5)]
    return {f.stem: f for f in picked}


def places_seen(clip: Clip, noise_mm: float, raw: bool) -> tuple[Keypoints, list[int]]:
    """The joints of a clip as keypoints, and which joint each is."""
    names = dict[str, int]()
    for role in find_roles(clip.skeleton).rows:
        place = ROLES.get(role.kind)
        if place is not None:
            name = f"{role.side}_{place}" if role.side else place
            names.setdefault(role.role if place == "spine" else name, role.joint)
    joints = list(names.values())
    pos = clip.positions()[:, joints]
    pos = pos + np.random.default_rng(0).normal(size=pos.shape) * noise_mm / 1000 / np.sqrt(3)
    return Keypoints(tuple(names), pos, clip.fps, clip.name, source=Source(raw=raw)), joints


def by_analytic_ik(points: Keypoints, fitted: Clip) -> Clip:
    """The skeleton that was measured on keypoints, posed by the analytic inverse kinematics from the
    tracks that the fit sees."""
    config = FitConfig()
    marks = complete(points, config.max_gap_s, config.drop_spikes, config.smooth_hz)
    tracks, spine = trunk_tracks(dict(marks.tracks), [])
    rest = measure(tracks, spine, [])
    tracks = hold_lengths(tracks, bones_of(rest))
    skeleton, pos = fitted.skeleton, fitted.positions()
    at = {n: tracks[p] if p else pos[:, skeleton.index(n)] for n, p in rest.points.items()}
    table = generate_table(skeleton, ResidualForce().body, [fitted])
    seen = np.stack([at[n] for n in skeleton.names], 1)
    qpos = analytic_ik(seen, ik_body(table, skeleton), names=skeleton.names)
    return qpos_to_clip(qpos, table, skeleton, fitted.fps, name=fitted.name)


def places_units(places: Places) -> list[str]:
    """Clips, noise, and whether it is left as it is."""
    how = [f"{mm:g} mm{', as it is' if raw else ''}" for mm, raw in SEEN]
    return [f"{name}; {seen}" for name in clips_of_places(places) for seen in how]


def placed(places: Places, unit: str) -> Any:
    """Rotations from places alone, by the fit and by the analytic inverse kinematics: how far joints lie
    from where they were, how far bones turn beyond a constant turn, and how smooth that is."""
    stem, _, seen = unit.partition("; ")
    noise, raw = float(seen.split()[0]), seen.endswith("as it is")
    clip = resample(read_clip(clips_of_places(places)[stem]), PLACES_FPS)
    clip = trim(clip, 0, min(clip.frames, round(PLACES_SECONDS * PLACES_FPS)) - 1)
    points, joints = places_seen(clip, noise, raw)
    fitted, truth = fit_clip(points), clip.positions()
    pairs = [
        (fitted.skeleton.index(j), joints[points.names.index(p)])
        for j, p in JOINT_PLACES.items()
        if j in fitted.skeleton.names and p in points.names
    ]
    mine, theirs = map(list, zip(*pairs, strict=True))
    still = np.linalg.norm(truth - truth[:1], axis=-1)[:, theirs]
    out = {"still_mm": 1000 * float(still.mean()), "recorded_jerk": turning_jerk(clip, theirs)}
    for name, make in (
        ("fit", lambda: fit_clip(points)),
        ("ik", lambda: by_analytic_ik(points, fitted)),
    ):
        begun = time.process_time()
        made = make()
        took = time.process_time() - begun
        off = 1000 * np.linalg.norm(made.positions()[:, mine] - truth[:, theirs], axis=-1)
        out |= {
            f"{name}_mm": float(off.mean()),
            f"{name}_p95_mm": float(np.quantile(off, 0.95)),
            f"{name}_turn_deg": turned_apart(made, mine, clip, theirs),
            f"{name}_jerk_rad_per_s3": turning_jerk(made, mine),
            f"{name}_cpu_ms": 1000 * took,
        }
    return out


def turning_jerk(clip: Clip, joints: list[int]) -> float:
    """The second difference of local turning speeds, rad/s^3, in the mean of joints and frames."""
    q = clip.rot[:, joints]
    speed = quat_to_rotvec(quat_between(q[:-1], q[1:])) * clip.fps
    return float(np.linalg.norm(np.diff(speed, n=2, axis=0), axis=-1).mean() * clip.fps**2)


def turned_apart(made: Clip, mine: list[int], truth: Clip, theirs: list[int]) -> float:
    """Mean angle, degrees, between world rotations of bones beyond a constant turn of each, which is how
    two skeletons name their axes."""
    between = quat_between(truth.world()[1][:, theirs], made.world()[1][:, mine])
    # The mean turn is the eigenvector of the largest eigenvalue of sum q q^T (Markley et al. 2007).
    mean = np.linalg.eigh(np.einsum("tji,tjk->jik", between, between))[1][..., -1]
    cosine = np.abs((between * mean).sum(-1)).clip(max=1.0)
    return float(np.degrees(2 * np.arccos(cosine)).mean())


def placed_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Means of the clips by noise, by the fit that reads keypoints and by the analytic IK."""
    for seen in dict.fromkeys(unit.partition("; ")[2] for unit in raws):
        found = [raw for unit, raw in raws.items() if unit.endswith(f"; {seen}")]
        title = f"Skeleton2Humanoid, places alone, noise {seen}"
        for key, name in (("fit", "the fit of keypoints"), ("ik", "analytic IK")):
            values = {
                k.removeprefix(f"{key}_"): mean_of(r[k] for r in found)
                for k in found[0]
                if k.startswith(f"{key}_")
            }
            yield from of(f"{title}; {name}", values, len(found))
        still, jerk = (mean_of(r[k] for r in found) for k in ("still_mm", "recorded_jerk"))
        yield Figure(f"{title}; nothing moves", "mm", still, len(found))
        yield Figure(f"{title}; as recorded", "jerk_rad_per_s3", jerk, len(found))


PARTS = {
    "skeleton": Part("Skeleton2Humanoid, Tables 1 and 4: policies", units, corrected, rows, hours=7.0),
    "skeleton-stages": Part(
        "Skeleton2Humanoid, Table 1: stages I and II and the floor", stage_units, staged, rows, hours=0.1
    ),
    "skeleton-iterations": Part(
        "Skeleton2Humanoid, Tables 5 and 6", iterated_units, iterated, iterated_rows, hours=0.1
    ),
    "skeleton-places": Part(
        "rotations from places of joints alone", places_units, placed, placed_rows, hours=0.02
    ),
}
