"""Trains the policy that is to come with Poise, on clips of CMU and DeepMimic.

    python benchmarks/tracker.py --library FOLDER --onto FOLDER/cmu_amc/02/02_01.amc -o RUN --minutes 60

FOLDER holds CMU clips as AMC and BVH and those of DeepMimic (`tracker/README.md` says which). Whole
subjects of CMU are held out. There is no help at any time: training begins with a search for motions
that need none. Ctrl-C and --resume as in `poise train perpetual`; the policy is written with
`poise.jobs.tracker.save_tracker` and measured by `perpetual.py`.
"""

from __future__ import annotations

import argparse
import contextlib
from dataclasses import replace
from pathlib import Path

from poise.body import BodyConfig
from poise.cli.perpetual_report import shown
from poise.cli.training import beginning
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.perpetual.run import begin, clips_of, resume, train
from poise.learn import ConvergenceConfig, Until
from poise.plan import TrajOptConfig
from poise.recipes.perpetual import Perpetual

#: Dances, a kick, boxing and exercises.
HELD_OUT = ("cmu 05$", "cmu 11$", "cmu 14$")
#: One take in two files.
TWINS = (r"fairmotion.*01_01", r"135_06")
#: Walks, which backwards are steps back.
BACKWARDS = ("expmaps.*walking", "02_0[12]", "131_0[12]")
#: CMU's files state 120 Hz throughout, but some were captured at 60.
SIXTY = (("(^|-)90_", 60.0), ("salsa", 60.0))


def config(seed: int) -> Perpetual:
    """A single network without help, motion prior and recovery, that adds to the reference's angles.

    In the end the steps become smaller: large ones learn hard moments, and lose some of them again.
    """
    plain = Perpetual.additive()
    return replace(
        plain,
        single=True,
        single_hidden=(1024, 512),
        recovery=False,
        help_start=0.0,
        cooling=0.4,
        trajopt=TrajOptConfig(),
        convergence=ConvergenceConfig(patience=1000),
        ppo=replace(plain.ppo, std=0.04, kl_target=None),
        seed=seed,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--library", type=Path, required=True)
    parser.add_argument("--onto", type=Path, required=True)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resume", action="store_true")
    a = parser.parse_args()
    settings, source = config(a.seed), str(a.library)
    if a.resume:
        imitation = resume(a.out, settings, source)
    else:
        how = LibraryConfig(rates=SIXTY, mirror=True, backwards=BACKWARDS)
        held = (HELD_OUT, TWINS, print, a.onto, how)
        library, notes = clips_of(a.library, BodyConfig(), *held)
        print(*notes, sep="\n")
        imitation = begin(a.out, library, settings, source)
    with contextlib.suppress(KeyboardInterrupt), shown() as show:
        train(imitation, a.out, Until(minutes=a.minutes), show, a.threads, beginning=beginning())


if __name__ == "__main__":
    main()
