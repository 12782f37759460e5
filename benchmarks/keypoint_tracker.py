"""Trains the policy of keypoints that comes with Poise: it is told where joints are, and no angles.

    python benchmarks/keypoint_tracker.py --library FOLDER -o RUN --minutes 96
    python benchmarks/keypoint_tracker.py --library FOLDER --from RUN -o LONGER --minutes 90

FOLDER holds the clips of the policy that comes with Poise (`tracker/README.md` says which). That policy
teaches this one in the states that it comes to (DAgger); PPO goes on from there with small steps: larger
ones lose within an update what was taught. Ctrl-C and --resume as in `poise train perpetual`; the policy
is written with `poise.jobs.tracker.save_tracker` and measured by `perpetual.py`.
"""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

from tracker import BACKWARDS, HELD_OUT, SIXTY, TWINS, parser_of

from poise.body import BodyConfig
from poise.cli.perpetual_report import shown
from poise.cli.training import beginning
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.open import open_run
from poise.jobs.perpetual.distillation import distilled, taught_by
from poise.jobs.perpetual.run import begin, clips_of, resume, train
from poise.jobs.tracker import SHIPPED
from poise.jobs.warm_start import widened
from poise.learn import CloneConfig, Until
from poise.recipes.perpetual import Perpetual


def config(teacher: Perpetual, rounds: int, seed: int) -> Perpetual:
    """The teacher's settings for places alone, with many rounds of teaching and small steps after it."""
    told = taught_by(teacher, goal="keypoints")
    ppo = replace(told.ppo, policy_lr=1e-5, kl_target=0.05, lr_range=(5e-6, 1e-4), critic_warmup=8)
    clone = CloneConfig(steps=256, rounds=rounds, epochs=(6, 2), most=600_000)
    return replace(told, ppo=ppo, clone=clone, num_envs=4096, evaluate_every=12, cooling=0.0, seed=seed)


def longer(earlier: Perpetual, step: float, seed: int) -> Perpetual:
    """The settings with which a policy of keypoints goes on: its own, without teaching."""
    ppo = replace(earlier.ppo, policy_lr=step, kl_target=0.05, lr_range=(5e-6, 1e-4), critic_warmup=8)
    return replace(
        earlier, ppo=ppo, clone=None, num_envs=4096, evaluate_every=12, cooling=0.0, seed=seed
    )


def main() -> None:
    parser = parser_of(__doc__, minutes=96.0)
    parser.add_argument("--teacher", type=Path, default=SHIPPED, help="a policy for rotations")
    parser.add_argument("--from", type=Path, dest="earlier", help="the policy of keypoints that goes on")
    parser.add_argument("--step", type=float, default=1.5e-5, help="of a policy that goes on")
    parser.add_argument("--rounds", type=int, default=24, help="of teaching, beside the teacher's own")
    a = parser.parse_args()
    teacher = open_run(a.earlier or a.teacher).tracker
    settings = (
        longer(teacher.config, a.step, a.seed) if a.earlier else config(teacher.config, a.rounds, a.seed)
    )
    source, trained = str(a.library), None
    if a.resume:
        imitation = resume(a.out, settings, source)
    else:
        how = LibraryConfig(rates=SIXTY, mirror=True, backwards=BACKWARDS)
        library, notes = clips_of(a.library, BodyConfig(), HELD_OUT, TWINS, print, teacher.target, how)
        print(*notes, sep="\n")
        imitation = begin(a.out, library, settings, source, earlier=teacher)
        trained = (
            widened(teacher, imitation)
            if a.earlier
            else distilled(teacher, imitation, a.threads, a.out / "dumps", beginning())
        )
    with contextlib.suppress(KeyboardInterrupt), shown() as show:
        until = Until(minutes=a.minutes)
        train(imitation, a.out, until, show, a.threads, beginning=beginning(), trained=trained)


if __name__ == "__main__":
    main()
