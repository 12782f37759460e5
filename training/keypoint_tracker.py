r"""Trains the policy of keypoints that comes with Poise: it is told where joints are, and no angles.

    python training/keypoint_tracker.py --library FOLDER -o RUN --minutes 96
    python training/keypoint_tracker.py --library FOLDER --from RUN -o LONGER --minutes 90
    python training/keypoint_tracker.py --library FOLDER --from RUN -o LARGER --rounds 40 \
        --device cuda --worlds 16384 --minibatch 16384 --step 3e-5 --minutes 8

FOLDER holds the clips of the policy that comes with Poise (`training/README.md` says which). That policy
teaches this one in the states that it comes to (DAgger); PPO goes on from there with small steps: larger
ones lose within an update what was taught. Ctrl-C and --resume as in `poise train perpetual`; the policy
is written with `poise.jobs.tracker.save_tracker` and measured by `python -m benchmarks track`.
"""

from __future__ import annotations

import argparse
import contextlib
from dataclasses import replace
from pathlib import Path

from tracker import BACKWARDS, HELD_OUT, SIXTY, TWINS, parser_of

from poise.body import BodyConfig
from poise.cli.train_perpetual import shown
from poise.cli.training import beginning
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.open import open_run
from poise.jobs.perpetual.distillation import distilled, taught_by
from poise.jobs.perpetual.perpetual_run import begin, clips_of, resume, train
from poise.jobs.tracker import SHIPPED
from poise.jobs.warm_start import CLONE_WORLDS, widened
from poise.learn import LATEST, CloneConfig, Until
from poise.recipes.perpetual_settings import Perpetual

#: Control steps of a round of teaching.
TAUGHT = 131_072


def config(told: Perpetual, options: argparse.Namespace) -> Perpetual:
    """The settings of a policy for places alone: some rounds of teaching, then small steps.

    told: those of a policy of keypoints that goes on, or the teacher's for places (`taught_by`).
    """
    a = options
    # Steps that become smaller are fixed, others keep to a divergence.
    target = None if a.cooling else 0.05
    ppo = replace(told.ppo, policy_lr=a.step, kl_target=target, lr_range=(5e-6, 1e-4), critic_warmup=8)
    taught = CloneConfig(steps=TAUGHT // a.worlds, rounds=a.rounds, epochs=(6, 2), most=600_000)
    return replace(
        told,
        ppo=replace(ppo, minibatch=a.minibatch or ppo.minibatch),
        clone=taught if a.rounds else None,
        num_envs=max(4096, a.worlds),
        evaluate_every=a.every,
        cooling=a.cooling,
        seed=a.seed,
    )


def main() -> None:
    parser = parser_of(__doc__, minutes=96.0)
    parser.add_argument("--teacher", type=Path, default=SHIPPED, help="a policy for rotations")
    parser.add_argument("--from", type=Path, dest="earlier", help="the policy of keypoints that goes on")
    parser.add_argument("--step", type=float, default=1e-5, help="of the policy, at first")
    parser.add_argument("--rounds", type=int, help="of teaching; 24, with --from none")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--worlds", type=int, default=CLONE_WORLDS, help="characters that are taught")
    parser.add_argument("--minibatch", type=int, help="by default the teacher's")
    parser.add_argument("--cooling", type=float, default=0.0, help="share with smaller steps")
    parser.add_argument("--every", type=int, default=12, help="iterations between evaluations")
    a = parser.parse_args()
    teacher = open_run(a.teacher).tracker
    earlier = open_run(a.earlier).tracker if a.earlier else None
    a.rounds = (0 if earlier else 24) if a.rounds is None else a.rounds
    told = earlier.config if earlier else taught_by(teacher.config, goal="keypoints")
    settings, source = config(told, a), str(a.library)
    if a.resume:
        imitation = resume(a.out, settings, source, a.device)
    else:
        how = LibraryConfig(rates=SIXTY, mirror=True, backwards=BACKWARDS)
        library, notes = clips_of(a.library, BodyConfig(), HELD_OUT, TWINS, print, teacher.target, how)
        print(*notes, sep="\n")
        imitation = begin(a.out, library, settings, source, a.device, earlier or teacher)
    trained = widened(earlier, imitation) if earlier else None
    if a.rounds and not (a.out / LATEST).exists():
        start = trained.policy if trained else None
        where = (a.threads, a.out / "dumps", beginning(), a.device, a.worlds, start)
        trained = distilled(teacher, imitation, *where)
    with contextlib.suppress(KeyboardInterrupt), shown() as show:
        first, until = beginning(), Until(minutes=a.minutes)
        train(imitation, a.out, until, show, a.threads, True, a.device, first, trained=trained)


if __name__ == "__main__":
    main()
