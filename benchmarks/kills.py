"""Trainings that are killed (-9) at random moments and gone on with: do they end as ones that were not?

python benchmarks/kills.py --kills 50 --minutes 10 --seed 1 --json benchmarks/kills.json

Each recipe trains a miniature once without a kill. Then the same command is started, killed after a
random time and started again with --resume, up to three times a run, and goes on to its end. Every file
that a run leaves is compared bit for bit; only clocks may differ. Another call with another seed adds to
the figures.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

import poise
from poise.cli.main import main as command_line
from poise.formats import read_clip, write_clip
from poise.learn.checkpoint import load_checkpoint
from poise.motion import Clip, trim

WALK = Path(poise.__file__).parent / "data/walk.bvh"
#: Kills of one run at most.
MOST = 3
#: Where a state keeps its clock: the tensor, and the number in it.
CLOCKS = {"trainer/counters": 2, "counters": 1}

#: Names in JSON of clocks and of sums over them. "begun" is when a stage began, in samples and seconds.
_CLOCKS = ("seconds", "crc32", "minutes", "begun")


def miniature(folder: Path) -> None:
    """Clips and settings of trainings that take seconds."""
    from poise.jobs.endless.endless_training import Endless
    from poise.jobs.inbetween.inbetween_settings import Inbetween, small
    from poise.learn.cvae import CVAEConfig
    from poise.settings import to_toml

    clip = read_clip(WALK)
    (folder / "clips").mkdir()
    for k in range(3):
        cut: Clip = trim(clip, 10 * k, None).replaced(name=f"walk{k}")
        write_clip(cut, folder / f"clips/walk{k}.bvh")
    write_clip(trim(clip, 0, 20), folder / "short.bvh")
    between = small(Inbetween())
    between = replace(between, between_training=replace(between.between_training, batch=2, longest=20))
    (folder / "inbetween.toml").write_text(to_toml(between))
    net = CVAEConfig(past=10, future=12, latent=4, hidden=16, decoder="cosine", cosines=6)
    (folder / "endless.toml").write_text(to_toml(Endless(net)))


def tiny_perpetual() -> None:
    """The recipe with networks that are trained in no time, in this process alone."""
    from poise.cli import train_perpetual
    from poise.learn import CloneConfig, PPOConfig
    from poise.papers.perpetual.ablations import StagedPerpetual
    from poise.recipes.perpetual_settings import RecoveryPlan

    ppo = PPOConfig(horizon=4, epochs=1, std=0.02, policy_hidden=(8,), value_hidden=(8,))
    own: dict[str, Any] = {
        "ppo": ppo, "clone": CloneConfig(steps=4, rounds=0, critic_steps=4), "style": None,
        "recovering": RecoveryPlan(falls=4, trials=2, final_trials=2, seconds=(0.1, 0.2)),
    }  # fmt: skip
    train_perpetual.recipe = lambda additive: StagedPerpetual(**own)


def command(recipe: str, here: Path, out: Path) -> list[str]:
    """The miniature of a recipe."""
    few = ["--threads", "1", "-o", str(out)]
    library = ["--library", str(here / "clips")]
    return {
        "imitate": ["imitate", str(here / "short.bvh"), "--iterations", "6", "--envs", "16", *few],
        "perpetual": ["train", "perpetual", *library, "--envs", "8", "--iterations", "6",
                      "--max-primitives", "2", *few],
        "inbetween": ["train", "inbetween", *library, "--iterations", "200",
                      "--config", str(here / "inbetween.toml"), *few],
        "endless": ["train", "endless", *library, "--iterations", "400",
                    "--config", str(here / "endless.toml"), *few],
    }[recipe]  # fmt: skip


def start(argv: list[str], log: Path) -> multiprocessing.process.BaseProcess:
    """`poise ARGV` in a process of its own, which shares what is imported here."""

    def child() -> None:
        os.setsid()
        for stream in (1, 2):
            os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND), stream)
        torch.set_num_threads(1)
        tiny_perpetual()
        sys.exit(command_line(argv))

    made = multiprocessing.get_context("fork").Process(target=child)
    made.start()
    return made


def finished(argv: list[str], log: Path, within: float) -> float:
    """Runs to the end; its seconds."""
    begun = time.monotonic()
    process = start(argv, log)
    process.join(within)
    if process.exitcode != 0:
        process.kill()
        said = log.read_text()[-2000:]
        raise SystemExit(f"{' '.join(argv)} ended with {process.exitcode}:\n{said}")
    return time.monotonic() - begun


def end_of(out: Path) -> dict[str, Any]:
    """What a run has left, by file; without clocks."""
    ends: dict[str, Any] = {}
    for path in sorted(p for p in out.rglob("*") if p.is_file()):
        name = str(path.relative_to(out))
        if path.suffix == ".safetensors":
            tensors, meta = load_checkpoint(path)
            for key, place in CLOCKS.items():
                if key in tensors and tensors[key].dtype == torch.float64:
                    tensors[key][place] = 0.0
            ends |= {f"{name}:{k}": v.contiguous().numpy().tobytes() for k, v in tensors.items()}
            ends[f"{name}:meta"] = timeless(meta)
        elif path.suffix == ".csv":
            header, *rows = (line.split(",") for line in path.read_text().splitlines())
            kept = [
                k for k, column in enumerate(header) if "time/" not in column and "seconds" not in column
            ]
            ends[name] = [[row[k] for k in kept] for row in (header, *rows)]
        elif path.suffix == ".json":
            ends[name] = timeless(json.loads(path.read_text()))
        elif path.suffix in (".bvh", ".npz"):
            ends[name] = path.read_bytes()
        elif "tensorboard" not in name:
            ends[name] = "there"
    return ends


def timeless(data: Any) -> Any:
    """JSON without clocks, and without the sum over the tensors, which hold one."""
    if isinstance(data, dict):
        kept = {k: v for k, v in data.items() if k not in _CLOCKS}
        return {k: timeless(v) for k, v in kept.items()}
    return [timeless(v) for v in data] if isinstance(data, list) else data


def differences(a: dict[str, Any], b: dict[str, Any]) -> list[str]:
    """What two ends do not have in common."""
    return sorted(k for k in a.keys() | b.keys() if a.get(k) != b.get(k))


def iteration(out: Path) -> int:
    """The last iteration in the log of a run, 0 where none is."""
    rows = [x.split(",") for p in out.rglob("log.csv") for x in p.read_text().splitlines()]
    return max((int(r[0]) for r in rows if r[0].isdigit()), default=0)


def killed(argv: list[str], out: Path, log: Path, seconds: float, rng: random.Random) -> int:
    """Kills and resumes up to `MOST` times, then runs to the end; how often it was killed."""
    count = 0
    for _ in range(rng.randint(1, MOST)):
        again = ["--resume"] if out.exists() else []
        process = start([*argv, *again], log)
        process.join(rng.uniform(0.05, 1.0) * seconds)
        if process.exitcode is not None:
            break
        os.kill(process.pid or 0, signal.SIGKILL)
        process.join()
        count += 1
    finished([*argv, "--resume"], log, 40 * seconds + 120)
    return count


def measure(
    recipe: str, kills: int, seed: int, end: float, known: dict[str, Any], save: Callable[[], None]
) -> None:
    """Runs of one recipe until so many kills were made or the time is over; adds to what is known."""
    with tempfile.TemporaryDirectory() as folder:
        here, rng = Path(folder), random.Random(f"{recipe} {seed}")
        miniature(here)
        log, whole = here / "log.txt", here / "whole"
        seconds = finished(command(recipe, here, whole), log, 900)
        expected, done = end_of(whole), 0
        known |= {"seconds_of_a_run": round(seconds, 1), "files": len(expected)}
        while done < kills and time.monotonic() < end:
            out = here / "killed"
            count = killed(command(recipe, here, out), out, log, seconds, rng)
            differ = differences(expected, end_of(out))
            left = [p.name for p in out.rglob("*.partial")]
            done += count
            known["kills"] += count
            known["runs"] += 1
            known["same"] += not differ and not left
            for key in [*differ, *left]:
                known["differ"][key] = known["differ"].get(key, 0) + 1
            save()
            shutil.rmtree(out)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--recipes", nargs="+", default=["imitate", "perpetual", "inbetween", "endless"])
    parser.add_argument("--kills", type=int, default=50, help="of each recipe, at least")
    parser.add_argument("--minutes", type=float, default=600.0, help="of each recipe, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    found: dict[str, Any] = {"seeds": [], "recipes": {}}
    if args.json is not None and args.json.exists():
        found = json.loads(args.json.read_text())
    found["seeds"] = sorted({*found["seeds"], args.seed})

    def save() -> None:
        print(json.dumps(found["recipes"]), flush=True)
        if args.json is not None:
            args.json.write_text(json.dumps(found, indent=1) + "\n")

    for recipe in args.recipes:
        row = found["recipes"].setdefault(recipe, {"kills": 0, "runs": 0, "same": 0, "differ": {}})
        end = time.monotonic() + 60 * args.minutes
        measure(recipe, args.kills, args.seed, end, row, save)


if __name__ == "__main__":
    main()
