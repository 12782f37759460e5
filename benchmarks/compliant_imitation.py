"""Deep Compliant Control's imitation controller from nothing, by an adversarial style and without.

    python benchmarks/compliant_imitation.py CLIP [CLIP ...] --work DIR -o FILE.json [--samples N]

Two trainings of the recipe for equally many control steps: r_q of the discriminator (Eq. 13), and r_q of
the distance to the reference's pose; hands are pushed and the level of compliance is 0.16 in both. Then
the mean actions run for 20 s in each of 16 worlds, without pushes, with the training's, and with
twice these. The row "targets" acts with nothing, which leaves the reference's angles to the servos.
Resumable.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from speed import machine
from torch import Tensor

from poise.env import ImitationEnv
from poise.env.task import Acts
from poise.formats import read_clip
from poise.learn import LATEST, IterationStats, Until, load_policy, run
from poise.motion import ClipLibrary
from poise.motion.rotations import into_heading
from poise.papers.compliant.imitation_controller import CompliantImitation, build
from poise.recipes.imitation import Imitation

#: Worlds, and s, of an evaluation.
WORLDS, SECONDS = 16, 20.0
#: Discriminator: pairs per step and steps per update; the paper's 16 pairs are for updates of 2,048.
PAIRS, STEPS = 256, 8


class Nothing:
    """Acts with zeros."""

    def __init__(self, width: int):
        self.width = width

    def act(self, obs: Tensor) -> Tensor:
        return obs.new_zeros(len(obs), self.width)


def local(pos: Tensor, heading: Tensor) -> Tensor:
    """Bodies `(N, B, 3)` from the root, in the heading frame."""
    return into_heading(heading, pos - pos[:, :1])


def figures(made: Imitation, act: Acts, newtons: float) -> dict[str, float]:
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
    for _ in range(round(SECONDS * 30.0)):
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
    minutes = WORLDS * SECONDS / 60.0
    return {
        "falls_a_minute": round(falls / minutes, 2), "root_m": round(float(torch.stack(far).mean()), 3),
        "nearest_pose_mm": round(float(torch.stack(near).mean()), 1),
        "jerk": round(float(ours), 1), "jerk_of_the_reference": round(float(asked), 1),
    }  # fmt: skip


def trained(made: Imitation, folder: Path, samples: int) -> Acts:
    """The policy after its training."""
    last = [0.0]

    def tell(s: IterationStats) -> None:
        if time.monotonic() - last[0] > 30.0:
            last[0] = time.monotonic()
            style = s.style.get("style_reward", float("nan"))
            told = f"{s.seconds / 60:.1f} min, reward {s.reward:.3f}, style {style:.2f}"
            print(f"{folder.name}: {told}, {s.episode_length:.0f} steps an episode", flush=True)

    trainer = made.trainer(threads=1, style=made.config.style)
    run(trainer, Until(samples=samples), folder, 20, tell, tensorboard=False)
    return load_policy(folder / LATEST)


def main() -> None:
    """Trains twice, looks, writes FILE.json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=1_200_000)
    parser.add_argument("--worlds", type=int, default=256)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--action", choices=("additive", "absolute"), default="additive")
    parser.add_argument("-o", type=Path, required=True)
    a = parser.parse_args()
    torch.set_num_threads(1)
    library = ClipLibrary.of([read_clip(p) for p in a.clips])
    base = CompliantImitation(num_envs=a.worlds, seed=a.seed, action=a.action)
    assert base.style is not None
    ways = {
        "adversarial": replace(base, style=replace(base.style, minibatch=PAIRS, steps=STEPS)),
        "pose": replace(base, style=None),
    }
    found: dict[str, Any] = {
        "command": "python benchmarks/compliant_imitation.py CLIPS --work DIR -o FILE.json",
        "clips": [p.stem for p in a.clips], "samples": a.samples, "action": a.action, "seed": a.seed,
        "machine": machine(), "rows": {},
    }  # fmt: skip
    for name, config in ways.items():
        made = build(library, config)
        acts = {name: trained(made, a.work / name, a.samples)}
        if name == "adversarial" and a.action == "additive":
            acts["targets"] = Nothing(len(made.humanoid.hinges))
        for row, act in acts.items():
            found["rows"][row] = {f"pushes x {k:g}": figures(made, act, k) for k in (0.0, 1.0, 2.0)}
            print(row, found["rows"][row], flush=True)
        a.o.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
