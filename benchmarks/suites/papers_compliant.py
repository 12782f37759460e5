"""Deep Compliant Control's imitation controller from nothing, by an adversarial style and without.

Two trainings of the recipe for equally many control steps: r_q of the discriminator (Eq. 13), and r_q of
the distance to the reference's pose; hands are pushed and the level of compliance is 0.16 in both. Then
the mean actions run for 20 s in each of 16 worlds, without pushes, with the training's, and with twice
these. "nothing" is the null, which leaves the reference's angles to the servos.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.common.clips import WALK, Places
from benchmarks.common.rows import Figure, of
from benchmarks.common.runner import Part, Raws
from benchmarks.common.starts import Nothing
from poise.env import ImitationEnv
from poise.env.task import Acts
from poise.formats import read_clip
from poise.learn import LATEST, Until, load_policy, run
from poise.motion import ClipLibrary
from poise.motion.rotations import into_heading
from poise.papers.compliant.imitation_controller import CompliantImitation, build
from poise.recipes.imitation import Imitation

#: Worlds, and s, of an evaluation.
WORLDS, SECONDS = 16, 20.0


#: Discriminator: pairs per step and steps per update; the paper's 16 pairs are for updates of 2,048.
PAIRS, STEPS = 256, 8


def local(pos: Tensor, heading: Tensor) -> Tensor:
    """Bodies `(N, B, 3)` from the root, in the heading frame."""
    return into_heading(heading, pos - pos[:, :1])


def figures(made: Imitation, act: Acts, newtons: float, seconds: float) -> dict[str, float]:
    """Falls a minute (the root 0.35 m below the reference's, or 1 m off), and means over all steps:
    metres from the reference's root, the root mean square distance of the bodies to the nearest of all
    clips' poses, mm, and jerk of the bodies beside the reference's."""
    config = made.config
    pushes = None if newtons == 0.0 else tuple(newtons * v for v in config.newtons)
    task = build(made.library, replace(config, newtons=pushes, style=None)).task
    env: ImitationEnv = replace(made, task=task).env(WORLDS, 11, threads=1, guard=False)
    rows = torch.arange(made.reference.frames)
    pose = made.reference.layout.unpacked(made.reference.packed(rows))
    known = local(pose.pos, pose.heading).flatten(1)
    obs, falls, tracks, theirs = env.observe(), 0, [], []
    far, near, ended = [], [], []
    for _ in range(max(4, round(seconds * 30.0))):
        step = env.step(act.act(obs))
        obs, fell = step.obs, step.failed
        falls += int(fell.sum())
        sim, ref = env.pose(), env.goal_pose()
        far.append((sim.pos[:, 0] - ref.pos[:, 0]).norm(dim=-1))
        apart = torch.cdist(local(sim.pos, sim.heading).flatten(1), known).amin(1)
        near.append(1000.0 * apart / len(made.humanoid.bodies) ** 0.5)
        tracks.append(sim.pos.clone())
        theirs.append(ref.pos.clone())
        ended.append(step.terminated | step.truncated)
    env.close()
    whole = torch.stack(ended)
    # Third differences that no new episode begins in.
    calm = ~(whole[:-3] | whole[1:-2] | whole[2:-1] | whole[3:])
    ours, asked = (
        torch.stack(x).diff(dim=0, n=3).norm(dim=-1).mean(-1)[calm].mean() * 30.0**3
        for x in (tracks, theirs)
    )
    minutes = WORLDS * seconds / 60.0
    return {
        "falls_a_minute": round(falls / minutes, 2),
        "root_m": round(float(torch.stack(far).mean()), 3),
        "nearest_pose_mm": round(float(torch.stack(near).mean()), 1),
        "jerk": round(float(ours), 1),
        "jerk_of_the_reference": round(float(asked), 1),
    }


def trained(made: Imitation, folder: Path, samples: int) -> Acts:
    """The policy after its training."""
    trainer = made.trainer(threads=1, style=made.config.style)
    run(trainer, Until(samples=samples), folder, 20, tensorboard=False)
    return load_policy(folder / LATEST)


SAMPLES, KINDS = 1_200_000, ("nothing (targets)", "adversarial", "pose")


def units(places: Places) -> list[str]:
    """The two trainings and the null."""
    return list(KINDS[: 2 if places.smoke else None])


def controlled(places: Places, unit: str) -> Any:
    """A training, and what its mean actions do under pushes."""
    worlds, samples = (8, 64) if places.smoke else (256, SAMPLES)
    config = CompliantImitation(num_envs=worlds)
    assert config.style is not None
    if places.smoke:
        config = replace(config, ppo=replace(config.ppo, horizon=4, minibatch=16))
        config = replace(config, style=replace(config.style, minibatch=8, steps=1))
    else:
        config = replace(config, style=replace(config.style, minibatch=PAIRS, steps=STEPS))
    if unit == "pose":
        config = replace(config, style=None)
    made = build(ClipLibrary.of([read_clip(WALK)]), config)
    by = Nothing(len(made.humanoid.hinges))
    act = by if unit.startswith("nothing") else trained(made, places.work / "compliant" / unit, samples)
    strengths = (0.0,) if places.smoke else (0.0, 1.0, 2.0)
    return {
        f"pushes x {k:g}": figures(made, act, k, 0.5 if places.smoke else SECONDS) for k in strengths
    }


def rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Falls a minute and means."""
    for unit, raw in raws.items():
        policy = "" if unit.startswith("nothing") else f"{unit} (trained for this table)"
        for pushes, values in raw.items():
            yield from of(
                f"Deep Compliant Control, controller; {unit}, {pushes}", values, WORLDS, policy=policy
            )


PARTS = {
    "compliant": Part(
        "Deep Compliant Control's imitation controller", units, controlled, rows, hours=1.0, needs=()
    )
}
