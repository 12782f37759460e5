r"""The paper's ablations on a small library, each run one switch away from the one it is compared with.

    python benchmarks/perpetual_ablations.py --library FOLDER --onto FILE -o RUNS [--samples 2000000]
    python benchmarks/perpetual.py --runs NAME=RUNS/NAME ... --parts table noise recovery owners curves
    python benchmarks/perpetual_ablations.py ... -o TAUGHT --only longer taught taught-ppo \
        --from RUNS/together-1 --minutes 6 --json benchmarks/perpetual_taught.json

Trains the runs of `ROWS` with the same samples, the cloning of the expert counted, without any help
(but for "uhc-helped") and without a motion prior (but for "style"), writes `perpetual_rows.json` and
`.md` of all that are done (see `perpetual_rows.py`) and prints the second command. A run that was
stopped is gone on with, finished ones stay. `--worker K --workers N` takes every Nth run, for several
processes at once; `--collect` trains nothing. The rows of `TAUGHT` go on from a finished run, for equal
times in place of equal samples.
"""

from __future__ import annotations

import argparse
import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import perpetual_rows
from tracker import SIXTY

from poise.body import BodyConfig
from poise.cli.train_perpetual import shown
from poise.cli.training import beginning
from poise.jobs import runs
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.open import open_run
from poise.jobs.perpetual.perpetual_run import RESULT, begin, clips_of, resume, train
from poise.jobs.run_file import RUN_FILE
from poise.jobs.warm_start import widened
from poise.learn import AmpConfig, LessonConfig, Until
from poise.motion import ClipLibrary
from poise.papers.perpetual.ablations import StagedPerpetual
from poise.plan import TeacherConfig
from poise.recipes.body_shapes import BodyShapes
from poise.recipes.perpetual import build
from poise.recipes.perpetual_settings import Perpetual
from poise.recipes.residual_force import ResidualForce

#: Every row adds what its name says to the one before; the last three stand for themselves.
LADDER = {
    "plain": {"termination": "all", "multiplicative": False, "recovery": False},
    "relaxed": {"multiplicative": False, "recovery": False},
    "multiplicative": {"progressive": False, "recovery": False},
    "progressive": {"recovery": False},
    "recovery": {},
    "one-large-network": {"single": True, "recovery": False},
    "absolute-rotations": {"action": "absolute", "recovery": False},
    "absolute-keypoints": {"action": "absolute", "goal": "keypoints", "recovery": False},
}
#: One switch away from a row of the ladder each.
MORE = {
    "no-energy": LADDER["relaxed"] | {"energy": 0.0},
    "style": LADDER["relaxed"] | {"style": AmpConfig()},
    "means": LADDER["progressive"] | {"combine": "means"},
    "primitives-1": LADDER["progressive"] | {"max_primitives": 1},
    "primitives-3": LADDER["progressive"] | {"max_primitives": 3},
    "primitives-4": LADDER["progressive"] | {"max_primitives": 4},
}
#: In the manner of UHC: one network, additive actions, its reward, a root force up to 100 N or none.
UHC = ("uhc", "uhc-helped")
#: What the tracker knows beside the paper, each by itself on the first and at last together.
_BARE = LADDER["relaxed"] | {"heading": "twist"}
_PRICES = {"action_rate": 3.0, "foot_slide": 0.2}
INGREDIENTS = {
    "bare": _BARE,
    "heading": _BARE | {"heading": "hips"},
    "window": _BARE | {"window": (2, 4, 8)},
    "filter": _BARE | {"filter": 0.5},
    "root": _BARE | {"root": 0.2},
    "prices": _BARE | _PRICES,
    "own-bodies": _BARE | {"shapes": BodyShapes(own=True)},
    "as-shipped": _BARE | {"window": (2, 4, 8), "root": 0.2} | _PRICES,
    "together": _BARE | {"heading": "hips", "window": (2, 4, 8), "filter": 0.5, "root": 0.2} | _PRICES,
}
#: From a run that is done: PPO alone, a teacher that looks ahead alone, both.
_FEW = {"num_envs": 128, "teacher": TeacherConfig()}
TAUGHT: dict[str, dict[str, Any]] = {
    "longer": {},
    "taught": _FEW,
    "taught-ppo": _FEW | {"lessons": LessonConfig(reinforce=True)},
}
ROWS = (*LADDER, *MORE, *UHC, *INGREDIENTS, *TAUGHT)


def settings(name: str, seed: int) -> Perpetual:
    """One run's."""
    additive = StagedPerpetual.additive(
        help_start=0.0, max_primitives=2, single_hidden=(1024, 512), seed=seed
    )
    # A small library has fewer hard moments, and the budget is small.
    additive = replace(additive, num_envs=512)
    ppo = replace(additive.ppo, minibatch=2048)
    if name.startswith("absolute"):
        # Noise in shares of a joint's range.
        ppo = replace(ppo, std=0.02)
    return replace(additive, ppo=ppo, **(LADDER | MORE | INGREDIENTS).get(name, {}))


def uhc(name: str, seed: int) -> ResidualForce:
    """The settings of one of `UHC`, with the learner of the others."""
    ppo = settings("relaxed", seed).ppo
    method = "rfc-implicit" if name == "uhc-helped" else "deepmimic"
    return ResidualForce(method=method, help_limit=100.0, help_start=None, ppo=ppo, seed=seed)


def library_at(a: argparse.Namespace, own: bool = False) -> ClipLibrary:
    """The clips on one skeleton. own: with the lengths of each clip's own bones."""
    how = LibraryConfig(rates=SIXTY, own_bones=own)
    library, notes = clips_of(a.library, BodyConfig(), (), (), print, a.onto, how)
    print(*notes, sep="\n")
    return library


def one(a: argparse.Namespace, name: str, seed: int) -> None:
    """Trains one run, or goes on with it; those of `TAUGHT` go on from `--from` for `--minutes`."""
    out, source, until = a.out / f"{name}-{seed}", str(a.library), Until(samples=a.samples)
    if (out / RESULT).exists() or (out / perpetual_rows.ROW).exists():
        return
    if name in UHC:
        task = runs.begin(out, library_at(a), uhc(name, seed))
        runs.train(task, out, until, threads=1, tensorboard=False)
        return
    config, earlier, trained = settings(name, seed), None, None
    if name in TAUGHT:
        earlier, until = open_run(a.earlier).tracker, Until(minutes=a.minutes)
        config = replace(earlier.config, expert=False, trajopt=None, seed=seed, **TAUGHT[name])
    if (out / RUN_FILE).exists():
        imitation = resume(out, config, source)
    else:
        library = library_at(a, config.shapes.own)
        imitation = begin(out, library, config, source, earlier=earlier)
        trained = widened(earlier, imitation) if earlier else None
    with contextlib.suppress(KeyboardInterrupt), shown() as show:
        train(imitation, out, until, show, 1, beginning=beginning(), trained=trained)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--library", type=Path, required=True)
    parser.add_argument("--onto", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=2_000_000)
    parser.add_argument("--from", type=Path, dest="earlier", help="where the rows of TAUGHT go on")
    parser.add_argument("--minutes", type=float, default=6.0, help="of those rows")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--only", nargs="+", choices=ROWS, default=list(LADDER))
    parser.add_argument("--worker", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--collect", action="store_true")
    parser.add_argument("--json", type=Path, default=Path(__file__).with_name("perpetual_rows.json"))
    a = parser.parse_args()
    jobs = [(name, seed) for seed in a.seeds for name in a.only]
    for k, (name, seed) in enumerate(jobs):
        if k % a.workers == a.worker and not a.collect:
            print(f"{name}, seed {seed}")
            one(a, name, seed)
    kept = a.out / "nothing.json"
    null = perpetual_rows.null_of(lambda: build(library_at(a), settings("relaxed", 0)), kept)
    small = set(a.only) <= {*INGREDIENTS, *TAUGHT}
    minutes = a.minutes if set(a.only) <= set(TAUGHT) else None
    perpetual_rows.write(a.out, a.samples, null, a.json, not small, minutes)
    named = " ".join(f"{n}-{s}={a.out}/{n}-{s}" for n, s in jobs if n not in UHC)
    print(f"python benchmarks/perpetual.py --runs {named} --parts table noise recovery owners curves")


if __name__ == "__main__":
    main()
