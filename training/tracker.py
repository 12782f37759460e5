r"""Trains the policy that is to come with Poise, on clips of CMU and DeepMimic.

    python training/tracker.py --library FOLDER --onto FOLDER/cmu_amc/02/02_01.amc -o RUN --minutes 60
    python training/tracker.py --library FOLDER --from RUN --step 4e-5 -o FINER --minutes 60
    python training/tracker.py --library FOLDER --from RUN -o LARGER --step 5e-5 --seed 7 \
        --recovery 0.3 --device cuda --worlds 16384 --minibatch 16384 --cooling 0.5 \
        --every 10000 --minutes 5.3
    python training/tracker.py ... --from LARGER -o SMOOTHER --step 4e-5 --std 0.03 \
        --acceleration 0.6 --slide 1
    python training/tracker.py ... --from SMOOTHER -o SMOOTHEST --step 3e-5 --std 0.02 \
        --acceleration 1.2 --slide 2
    python training/tracker.py ... --from POLICY -o TOUGHER --noise 0.25 0.5

FOLDER holds CMU clips as AMC and BVH and those of DeepMimic (`training/README.md` says which). Whole
subjects of CMU are held out. There is no help at any time: training begins with the clone of an expert
(with `--paths` of one that follows motions which need no help; looking for those is long where the
library is large), or goes on from a policy. Ctrl-C and --resume as in `poise train perpetual`; the
policy is written with `poise.jobs.tracker.save_tracker` and measured by `python -m benchmarks track`.
"""

from __future__ import annotations

import argparse
import contextlib
from dataclasses import replace
from pathlib import Path

from poise.body import BodyConfig, make_humanoid
from poise.cli.train_perpetual import shown
from poise.cli.training import beginning
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.open import open_run
from poise.jobs.perpetual.perpetual_run import begin, clips_of, going_on, resume, train
from poise.jobs.tracker import Tracker
from poise.jobs.warm_start import SMALL_STEP, widened
from poise.learn import ConvergenceConfig, Until
from poise.papers.perpetual.ablations import StagedPerpetual
from poise.papers.perpetual.trajopt import TrajOptConfig
from poise.recipes.perpetual_settings import Perpetual, PushPlan

#: Dances, a kick, boxing and exercises.
HELD_OUT = ("cmu 05$", "cmu 11$", "cmu 14$")
#: One take in two files.
TWINS = (r"fairmotion.*01_01", r"135_06")
#: Walks, which backwards are steps back.
BACKWARDS = ("expmaps.*walking", "02_0[12]", "131_0[12]")
#: CMU's files state 120 Hz throughout, but some were captured at 60.
SIXTY = (("(^|-)90_(?!05)", 60.0), ("salsa", 60.0))

#: The policy's step size from nothing.
STEP = 2e-4


def config(seed: int, paths: bool = False, step: float = STEP) -> StagedPerpetual:
    """A single network without help, motion prior and recovery, that adds to the reference's angles.

    It observes and pays for what the policy that comes with Poise does, its first update on. In the end
    the steps become smaller: large ones learn hard moments, and lose some of them again.

    step: of the policy, until then.
    """
    plain = StagedPerpetual.additive()
    return replace(
        plain,
        single=True,
        single_hidden=(1024, 512),
        recovery=False,
        help_start=0.0,
        cooling=0.4,
        trajopt=TrajOptConfig() if paths else None,
        window=(2, 4, 8),
        root=0.2,
        action_rate=3.0,
        foot_slide=0.2,
        convergence=ConvergenceConfig(patience=1000),
        ppo=replace(plain.ppo, std=0.04, kl_target=None, policy_lr=step),
        seed=seed,
    )


def finer(tracker: Tracker, options: argparse.Namespace) -> Perpetual:
    """The settings with which a policy goes on: the heading of the hips, later frames, a filter of its
    actions, a nearer root, prices of changing actions and of feet that slide, large batches.

    Args:
        options: those of `main`. Noise on the actions is rough: with `--std` 0.05 it doubles the
            acceleration, and the policy has little to gain by its own. `--filter` is the share of the
            last action that actions keep; with 0.5 all that a policy without knew of getting up is gone
            at once, and an hour does not bring it back. `--hips` changes all that is observed.
    """
    a = options
    kept = going_on(tracker.config, Perpetual(num_envs=a.worlds, seed=a.seed))
    recovering = replace(
        kept.recovering,
        demonstration_share=a.recovery,
        demonstrations=768 if a.quick else 512,
        quick=a.quick,
    )
    # A critic that does not know the new prices yet would undo what the policy knows.
    step = a.step or SMALL_STEP
    ppo = replace(kept.ppo, policy_lr=step, std=a.std, minibatch=a.minibatch, critic_warmup=8)
    ppo = replace(ppo, smooth_weight=a.smooth)
    return replace(
        kept,
        heading="hips" if a.hips else kept.heading,
        filter=a.filter,
        interpolate=a.interpolate or kept.interpolate,
        window=(2, 4, 8),
        root=0.2,
        action_rate=3.0,
        acceleration=a.acceleration,
        foot_slide=a.slide,
        recovering=recovering,
        evaluate_every=a.every,
        cooling=a.cooling,
        noise=tuple(a.noise),
        pushes=PushPlan() if a.pushes else kept.pushes,
        ppo=ppo,
    )


def softer(tracker: Tracker, seconds: float) -> Tracker:
    """The policy on its body with other contacts, see `BodyTable.soft_s`."""
    table = tracker.humanoid.table.overridden({"soft_s": seconds})
    body = tracker.config.body
    kept = tuple((k, v) for k, v in body.overrides if k != "soft_s")
    config = replace(tracker.config, body=replace(body, overrides=(*kept, ("soft_s", seconds))))
    return replace(tracker, humanoid=make_humanoid(tracker.humanoid.skeleton, table), config=config)


def parser_of(about: str, minutes: float) -> argparse.ArgumentParser:
    """The options that all trainings of a policy that comes with Poise have."""
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    parser.add_argument("--library", type=Path, required=True)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=minutes)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resume", action="store_true")
    return parser


def main() -> None:
    parser = parser_of(__doc__, minutes=60.0)
    parser.add_argument("--onto", type=Path, help="a clip on the skeleton of the body that is made")
    parser.add_argument("--from", type=Path, dest="earlier", help="the policy that goes on")
    parser.add_argument("--paths", action="store_true", help="searches for motions that need no help")
    parser.add_argument("--step", type=float, help=f"{STEP:g} from nothing, else 1e-4")
    parser.add_argument("--std", type=float, default=0.05)
    parser.add_argument("--filter", type=float, default=0.0)
    parser.add_argument("--interpolate", action="store_true", help="see Perpetual.interpolate")
    parser.add_argument("--hips", action="store_true")
    parser.add_argument("--acceleration", type=float, default=0.0, help="price of rough motion")
    parser.add_argument("--slide", type=float, default=0.2, help="price of feet that slide")
    parser.add_argument("--quick", action="store_true", help="see RecoveryPlan.quick")
    parser.add_argument("--noise", type=float, nargs="*", default=[], help="see Perpetual.noise")
    parser.add_argument("--pushes", action="store_true", help="see Perpetual.pushes")
    parser.add_argument("--smooth", type=float, default=0.0, help="see PPOConfig.smooth_weight")
    parser.add_argument("--damping", type=float, help="of the servos, kd / kp in s; else the policy's")
    parser.add_argument("--soft", type=float, help="see BodyTable.soft_s; else the policy's")
    parser.add_argument("--hold-out", nargs="*", default=HELD_OUT, help="none: all is learned")
    parser.add_argument("--samples", type=int, help="control steps at most")
    parser.add_argument("--recovery", type=float, default=0.4)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--worlds", type=int, default=4096, help="characters at once")
    parser.add_argument("--minibatch", type=int, default=8192)
    parser.add_argument("--cooling", type=float, default=0.0, help="share with smaller steps")
    parser.add_argument("--every", type=int, default=12, help="iterations between evaluations")
    a = parser.parse_args()
    if (a.onto is None) == (a.earlier is None):
        parser.error("give one of --onto and --from")
    earlier = open_run(a.earlier).tracker if a.earlier else None
    if earlier and a.damping:
        earlier = earlier.with_damping(a.damping)
    if earlier and a.soft:
        earlier = softer(earlier, a.soft)
    settings = finer(earlier, a) if earlier else config(a.seed, a.paths, a.step or STEP)
    source = str(a.library)
    if a.resume:
        imitation = resume(a.out, settings, source, a.device)
    else:
        how = LibraryConfig(rates=SIXTY, mirror=True, backwards=BACKWARDS)
        held = (a.hold_out, TWINS, print, earlier.target if earlier else a.onto, how)
        library, notes = clips_of(a.library, BodyConfig(), *held)
        print(*notes, sep="\n")
        imitation = begin(a.out, library, settings, source, a.device, earlier)
    # A run that has a checkpoint goes on from that.
    trained = widened(earlier, imitation) if earlier else None
    with contextlib.suppress(KeyboardInterrupt), shown() as show:
        until, first = Until(minutes=a.minutes, samples=a.samples), beginning()
        how = {"device": a.device, "beginning": first, "trained": trained}
        train(imitation, a.out, until, show, a.threads, **how)


if __name__ == "__main__":
    main()
