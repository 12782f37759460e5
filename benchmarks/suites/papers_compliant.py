"""Deep Compliant Control's imitation controller from nothing, by an adversarial style and without.

On one walk: two trainings of the recipe for equally many control steps, r_q of the discriminator
(Eq. 13), and r_q of the distance to the reference's pose; hands are pushed and the level of compliance
is 0.16 in both. Then the mean actions run for 20 s in each of 16 worlds, without pushes, with the
training's, and with twice these.

Planner in place: standing, walking, turning and running (`CLIPS`), and chains of them, with absolute
targets, so that the root alone is told, and with additive ones, which are told the next pose. Then a
hand of the standing character is pulled at `PULL` m/s for 8 s in 32 worlds, and nobody pulls it; and it
follows chains that it has not learned. A backflip (DeepMimic's), with both kinds of targets: 32 episodes
from the first frame, off by `SPREAD`.

All trainings have `SAMPLES` control steps. "nothing" is the null, which leaves the reference's angles to
the servos.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.common.clips import WALK, Places, moment, single
from benchmarks.common.rows import Figure
from benchmarks.common.runner import Part, Raws
from benchmarks.common.starts import SPREAD, Nothing
from benchmarks.suites.scenes import interval
from poise.env import ImitationEnv, Reference
from poise.env.task import Acts
from poise.formats import read_clip
from poise.jobs.result import RULE
from poise.kinematics import lowest_height
from poise.learn import LATEST, Until, load_policy, run
from poise.metrics import success_rule
from poise.motion import Clip, ClipLibrary
from poise.motion.rotations import into_heading
from poise.papers.compliant.controller_run import staged
from poise.papers.compliant.figures import FALLEN
from poise.papers.compliant.imitation_controller import CompliantImitation, build, chained, trainer
from poise.papers.compliant.scene_play import Looked
from poise.papers.compliant.scenes.body_scenes import HandInHand
from poise.papers.compliant.watch import footfalls
from poise.recipes.imitation import Imitation
from poise.score import run_episodes
from poise.score.rollouts import judge

#: Worlds, and s, of an evaluation.
WORLDS, SECONDS = 16, 20.0
#: Discriminator: pairs per step and steps per update; the paper's 16 pairs are for updates of 2,048.
PAIRS, STEPS = 256, 8
#: Control steps of each training.
SAMPLES = 1_000_000
#: One person who stands and raises a hand, walks, turns to the left, and runs: Bandai's second set.
CLIPS = {
    kind: f"other/bandai_bvh/dataset-2_{name}.bvh"
    for kind, name in (
        ("standing", "raise-up-right-hand_normal_003"),
        ("walking", "walk_normal_005"),
        ("turning", "walk-turn-left_normal_005"),
        ("running", "run_normal_005"),
    )
}
#: m/s at which a hand is pulled, s for which, and in how many worlds; m, a foot is lifted by more.
PULL, PULLED_S, PULLED, LIFTED_M = 0.5, 8.0, 32, 0.03
#: Seed of the chains that are followed, which trainings do not draw; s for which the nearest clip is to
#: be another one before it counts; s, so long does a velocity count beside places.
UNSEEN, LASTS_S, AHEAD_S = 1_000, 0.3, 0.2

WALKS = ("nothing (targets)", "adversarial", "pose")
KINDS = ("nothing (targets)", "absolute", "additive")
PLANNER, BACKFLIP = "planner in place", "backflip"


def local(pos: Tensor, heading: Tensor) -> Tensor:
    """Bodies `(N, B, 3)` from the root, in the heading frame."""
    return into_heading(heading, pos - pos[:, :1])


def figures(
    made: Imitation, act: Acts, newtons: float, seconds: float, goal: Reference | None = None
) -> dict[str, list[float]]:
    """Of each world falls a minute (the root 0.35 m below the reference's, or 1 m off), and means over
    all steps: metres from the reference's root, the root mean square distance of the bodies to the
    nearest of all clips' poses, mm, and jerk of the bodies beside the reference's.

    goal: followed in place of the clips. Then also how often a minute the nearest clip becomes another
    one, with the root's velocity, the same of the goal, and the share of steps in which both are of one.
    """
    config, count = made.config, len(made.library)
    pushes = None if newtons == 0.0 else tuple(newtons * v for v in config.newtons)
    settings = replace(config, newtons=pushes, style=None, chains=0)
    asked = replace(made, task=build(made.library, settings).task, reference=goal or made.reference)
    env: ImitationEnv = asked.env(WORLDS, 11, threads=1, guard=False)
    length = made.reference.length[:count]
    pose = made.reference.layout.unpacked(made.reference.packed(torch.arange(int(length.sum()))))
    of = torch.arange(count).repeat_interleave(length)
    known, size = local(pose.pos, pose.heading).flatten(1), len(made.humanoid.bodies) ** 0.5
    moves = into_heading(pose.heading, pose.linvel[:, :1]).flatten(1)
    both = torch.cat((known / size, AHEAD_S * moves), 1)
    obs, fell, tracks, theirs = env.reset(), torch.zeros(WORLDS), [], []
    far, near, ended = [], [], []
    nearest: tuple[list[Tensor], list[Tensor]] = [], []
    for _ in range(max(4, round(seconds * 30.0))):
        step = env.step(act.act(obs))
        obs = step.obs
        fell += step.failed
        sim, ref = env.pose(), env.goal_pose()
        far.append((sim.pos[:, 0] - ref.pos[:, 0]).norm(dim=-1))
        apart = torch.cdist(local(sim.pos, sim.heading).flatten(1), known).amin(1)
        near.append(1000.0 * apart / size)
        tracks.append(sim.pos.clone())
        theirs.append(ref.pos.clone())
        ended.append(step.terminated | step.truncated)
        for labels, one in zip(nearest, (sim, ref), strict=True) if goal is not None else ():
            goes = into_heading(one.heading, one.linvel[:, :1]).flatten(1)
            here = torch.cat((local(one.pos, one.heading).flatten(1) / size, AHEAD_S * goes), 1)
            labels.append(of[torch.cdist(here, both).argmin(1)])
    env.close()
    whole, minutes = torch.stack(ended), seconds / 60.0
    # Third differences that no new episode begins in.
    calm = ~(whole[:-3] | whole[1:-2] | whole[2:-1] | whole[3:])
    ours, wanted = (
        (torch.stack(x).diff(dim=0, n=3).norm(dim=-1).mean(-1) * calm).sum(0) * 30.0**3 / calm.sum(0)
        for x in (tracks, theirs)
    )
    out = {
        "falls_a_minute": fell / minutes,
        "root_m": torch.stack(far).mean(0),
        "nearest_pose_mm": torch.stack(near).mean(0),
        "jerk": ours,
        "jerk_of_the_reference": wanted,
    }
    if goal is not None:
        mine, asks = (torch.stack(labels) for labels in nearest)
        out["transitions_a_minute"] = changes(mine, whole) / minutes
        out["transitions_of_the_goal"] = changes(asks, whole) / minutes
        out["as_the_goal"] = (mine == asks).float().mean(0)
    return {k: v.tolist() for k, v in out.items()}


def changes(labels: Tensor, ended: Tensor, lasts: int = round(30.0 * LASTS_S)) -> Tensor:
    """`(N,)` how often labels `(T, N)` become others that stay for so many steps; a new episode, after
    `ended (T, N)`, begins with its own."""
    count = torch.zeros(labels.shape[1])
    for n in range(labels.shape[1]):
        now, other, since = -1, -1, 0
        for label, over in zip(labels[:, n].tolist(), ended[:, n].tolist(), strict=True):
            since = since + 1 if label == other else 1
            other = label
            if since >= lasts and label != now:
                count[n] += now >= 0
                now = label
            if over:
                now, other, since = -1, -1, 0
    return count


def stepping(looked: Looked) -> dict[str, list[float]]:
    """Of each episode until it falls: how often a foot comes down that was higher than `LIFTED_M`, how
    far its root goes along the pull, m, and whether it falls."""
    r, body = looked.rollouts, looked.task.humanoid
    height = r.pos[:, :, 0, 2]
    down = height < FALLEN * height[:, :1]
    fell, frames = down.any(1), down.shape[1]
    last = torch.where(fell, down.long().argmax(1) - 1, frames - 1).clamp_min(0)
    at = torch.minimum(torch.arange(frames).unsqueeze(0), last.unsqueeze(1))
    rows = torch.arange(len(last)).unsqueeze(1)
    low = lowest_height(body.table, r.pos, r.quat)[..., list(body.feet)]
    way = r.pos[rows[:, 0], last, 0, 1] - r.pos[:, 0, 0, 1]
    found = {"steps": footfalls(low[rows, at], LIFTED_M), "along_m": way, "lost": fell}
    return {k: v.double().tolist() for k, v in found.items()}


def flipping(made: Imitation, act: Acts, count: int) -> dict[str, list[float]]:
    """Of each episode whether it is lost between the first frame and the last one, and metres from the
    reference's root."""
    zero = torch.zeros(count, dtype=torch.long)
    rollouts, _ = run_episodes(
        lambda n: made.env(n, None, False, 1, guard=False),
        act,
        zero,
        zero,
        cycles=1,
        trial=torch.arange(count),
        spread=SPREAD,
    )
    far = (rollouts.pos[:, :, 0] - rollouts.ref_pos[:, :, 0]).norm(dim=-1).mean(1)
    lost = judge(rollouts, success_rule(RULE)).failed_at >= 0
    return {"lost": lost.double().tolist(), "root_m": far.tolist()}


def trained(made: Imitation, folder: Path, samples: int) -> Acts:
    """The policy after its training."""
    learner = trainer(made, 1)
    run(learner, Until(samples=samples), folder, 20, tensorboard=False)
    learner.close()
    return load_policy(folder / LATEST)


def units(places: Places) -> list[str]:
    """The trainings and the nulls."""
    every = [
        *WALKS,
        *(f"{what}, {kind}" for what in (PLANNER, BACKFLIP) for kind in KINDS),
    ]
    return [u for u in every if not places.smoke or not u.endswith(("pose", "additive"))]


def settings(places: Places) -> CompliantImitation:
    """Those of all trainings."""
    config = CompliantImitation(num_envs=8 if places.smoke else 256)
    assert config.style is not None
    if places.smoke:
        config = replace(config, ppo=replace(config.ppo, horizon=4, minibatch=16))
        return replace(config, style=replace(config.style, minibatch=8, steps=1))
    return replace(config, style=replace(config.style, minibatch=PAIRS, steps=STEPS))


def samples_of(places: Places) -> int:
    """Control steps of each training."""
    return 64 if places.smoke else SAMPLES


def clips(places: Places, what: str) -> list[Clip]:
    """The task that a unit learns."""
    if what == BACKFLIP:
        return [single(places, "backflip")]
    if what != PLANNER:
        return [read_clip(WALK)]
    if places.smoke:
        return [moment(kind) for kind in ("standing", "walking")]
    return [read_clip(places.file(file)).replaced(name=kind) for kind, file in CLIPS.items()]


def controlled(places: Places, unit: str) -> Any:
    """A training, and what its mean actions do."""
    what, _, kind = unit.rpartition(", ")
    config, seconds = settings(places), 0.5 if places.smoke else SECONDS
    if what:
        config = replace(config, action="absolute" if kind == "absolute" else "additive")
    if what == BACKFLIP:
        config = replace(config, newtons=None, level=None)
    if kind == "pose":
        config = replace(config, style=None)
    made = build(ClipLibrary.of(clips(places, what)), config)
    folder = places.work / "compliant" / f"{what}{kind}"
    act: Acts = Nothing(len(made.humanoid.hinges))
    if not kind.startswith("nothing"):
        act = trained(made, folder, samples_of(places))
    if what == BACKFLIP:
        return {"": flipping(made, act, 4 if places.smoke else PULLED)}
    if what == PLANNER:
        goal = chained(alone(made), WORLDS, SECONDS, UNSEEN)
        hands = (HandInHand(lead=PULL, sway=0.0), None)
        ask = (0.5, config.level, 4) if places.smoke else (PULLED_S, config.level, PULLED)
        pulled, calm = (stepping(staged(made, s, act, *ask, threads=1)) for s in hands)
        return {
            f"a hand pulled at {PULL:g} m/s": pulled,
            "nobody pulls": calm,
            "from clip to clip": figures(made, act, 0.0, seconds, goal),
        }
    strengths = (0.0,) if places.smoke else (0.0, 1.0, 2.0)
    return {f"pushes x {k:g}": figures(made, act, k, seconds) for k in strengths}


def alone(made: Imitation) -> Reference:
    """The clips without the chains that are learned."""
    return build(made.library, replace(made.config, chains=0)).reference


def rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Means over worlds, with their intervals."""
    for unit, raw in raws.items():
        nothing = unit.endswith(WALKS[0])
        policy = "" if nothing else f"{unit} (trained for this table)"
        for how, values in raw.items():
            subject = f"Deep Compliant Control, controller; {unit}{', ' if how else ''}{how}"
            for name, each in values.items():
                known = [v for v in each if v == v]
                if known:
                    mean, spread = statistics.fmean(known), interval(known, name)
                    # The table has a share's interval of its own.
                    spread = "" if name == "lost" else spread
                    yield Figure(subject, name, mean, len(known), spread, 1, policy)
            if not nothing:
                yield Figure(subject, "samples", samples_of(places), 1, policy=policy)


PARTS = {
    "compliant": Part(
        "Deep Compliant Control's imitation controller",
        units,
        controlled,
        rows,
        hours=1.0,
    )
}
