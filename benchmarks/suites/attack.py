"""Hostile files, and of trainings that are killed: one sentence, what time, what memory.

Every file is made in `tests/fuzz/hostile.py` by a few lines and read in a process of its own, which is
stopped after three minutes of processor time or at 6 GB. `ok` says that it was read or refused in one
sentence, within 30 s and 1.5 GB, or for larger files within what a sound one may take: 5 s and a
second a megabyte, 200 MB and four times its size. Miniatures of four recipes are killed (-9) at random
moments and resumed, and end as one that was not. The null is a sound file, and a run that nobody kills.
`tests/fuzz` makes a million damaged files.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch

from benchmarks.common.clips import WALK, Places
from benchmarks.common.rows import Figure, of
from benchmarks.common.runner import Part, Raws
from poise.cli.main import main as command_line
from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from poise.learn.checkpoint import load_checkpoint
from poise.motion import Clip, trim
from tests.fuzz.hostile import CASES, HELD, case, held, read

SECONDS, BYTES, STOP_S, STOP_BYTES = 30.0, 1.5e9, 180, 6 << 30


def child(pipe: Connection, name: str, folder: str) -> None:
    """Makes and reads; what came of it goes into the pipe."""
    resource.setrlimit(resource.RLIMIT_CPU, (STOP_S, STOP_S))
    resource.setrlimit(resource.RLIMIT_DATA, (STOP_BYTES, STOP_BYTES))
    torch.set_num_threads(1)
    try:
        CASES[name](Path(folder))
        said = ("read", "")
    except PoiseError as error:
        said = ("refused", str(error).replace(folder + "/", ""))
    except BaseException as error:
        said = ("fault", f"{type(error).__name__}: {error}"[:300])
    own, below = (resource.getrusage(k) for k in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    seconds = own.ru_utime + own.ru_stime + below.ru_utime + below.ru_stime
    memory = max(held(most=True) - (HELD[0] if HELD else 0), below.ru_maxrss)
    size = sum(p.stat().st_size for p in Path(folder).rglob("*") if p.is_file())
    pipe.send((*said, seconds, memory * 1024, size))


def started(target: Callable[..., None], *args: Any) -> multiprocessing.process.BaseProcess:
    """The function in a process of its own, forked from one that has imported this and has no threads.

    A fork of this process may wait for threads that do not come along.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    made = context.Process(target=target, args=args)
    made.start()
    return made


def outcome(name: str) -> dict[str, Any]:
    """One row of the table."""
    with tempfile.TemporaryDirectory() as folder:
        here, there = multiprocessing.Pipe()
        begun = time.monotonic()
        process = started(child, there, name, folder)
        there.close()
        kind, said, seconds, memory, size = "no answer", "", float(STOP_S), 0, 0
        # A process that waits needs no processor time: the limit on that does not end it.
        try:
            if here.poll(2 * STOP_S):
                kind, said, seconds, memory, size = here.recv()
            else:
                process.kill()
        except EOFError:
            process.join()
            kind = f"exit code {process.exitcode}"
        process.join()
    # What a sound file of that size may take.
    quick = seconds < max(SECONDS, 5 + size / 1e6)
    small = memory < max(BYTES, 4 * size + 200e6)
    fine = kind in ("read", "refused") and len(said) < 310 and quick and small
    wall = time.monotonic() - begun
    return {
        "what": name,
        "outcome": kind,
        "said": said,
        "cpu_s": round(seconds, 1),
        "wall_s": round(wall, 1),
        "peak_mb": round(memory / 1e6),
        "file_mb": round(size / 1e6, 1),
        "ok": fine,
    }


# --- kills ------------------------------------------------------------------------------------------


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
        "ppo": ppo,
        "clone": CloneConfig(steps=4, rounds=0, critic_steps=4),
        "style": None,
        "recovering": RecoveryPlan(falls=4, trials=2, final_trials=2, seconds=(0.1, 0.2)),
    }
    train_perpetual.recipe = lambda additive: StagedPerpetual(**own)


def command_of(recipe: str, here: Path, out: Path) -> list[str]:
    """The miniature of a recipe."""
    few = ["--threads", "1", "-o", str(out)]
    library = ["--library", str(here / "clips")]
    perpetual = ["--envs", "8", "--iterations", "6", "--max-primitives", "2"]
    inbetween = ["--iterations", "200", "--config", str(here / "inbetween.toml")]
    endless = ["--iterations", "400", "--config", str(here / "endless.toml")]
    return {
        "imitate": ["imitate", str(here / "short.bvh"), "--iterations", "6", "--envs", "16", *few],
        "perpetual": ["train", "perpetual", *library, *perpetual, *few],
        "inbetween": ["train", "inbetween", *library, *inbetween, *few],
        "endless": ["train", "endless", *library, *endless, *few],
    }[recipe]


def miniature_of(argv: list[str], log: Path) -> None:
    """`poise ARGV` with tiny networks; what it says goes into a file."""
    os.setsid()
    for stream in (1, 2):
        os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND), stream)
    torch.set_num_threads(1)
    tiny_perpetual()
    sys.exit(command_line(argv))


def finished(argv: list[str], log: Path, within: float) -> float:
    """Runs to the end; its seconds."""
    begun = time.monotonic()
    process = started(miniature_of, argv, log)
    process.join(within)
    if process.exitcode != 0:
        process.kill()
        said = log.read_text()[-2000:]
        raise SystemExit(f"{' '.join(argv)} ended with {process.exitcode}:\n{said}")
    return time.monotonic() - begun


def end_of(out: Path) -> dict[str, Any]:
    """Results of a run, by file; without clocks."""
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
    """Differences of two ends: all that they do not have in common."""
    return sorted(k for k in a.keys() | b.keys() if a.get(k) != b.get(k))


def killed(argv: list[str], out: Path, log: Path, seconds: float, rng: random.Random) -> int:
    """Kills and resumes up to `MOST` times, then runs to the end; how often it was killed."""
    count = 0
    for _ in range(rng.randint(1, MOST)):
        again = ["--resume"] if out.exists() else []
        process = started(miniature_of, [*argv, *again], log)
        process.join(rng.uniform(0.05, 1.0) * seconds)
        if process.exitcode is not None:
            break
        os.kill(process.pid or 0, signal.SIGKILL)
        process.join()
        count += 1
    finished([*argv, "--resume"], log, 40 * seconds + 120)
    return count


def measure(recipe: str, kills: int, seed: int, short: bool) -> dict[str, Any]:
    """Runs of one recipe until so many kills were made, and one that nobody kills."""
    known: dict[str, Any] = {"kills": 0, "runs": 0, "same": 0, "differ": {}}
    with tempfile.TemporaryDirectory() as folder:
        here, rng = Path(folder), random.Random(f"{recipe} {seed}")
        miniature(here)
        log, whole, again = here / "log.txt", here / "whole", here / "again"
        few = ["--iterations", "40"] if short else []
        seconds = finished([*command_of(recipe, here, whole), *few], log, 900)
        expected = end_of(whole)
        finished([*command_of(recipe, here, again), *few], log, 900)
        known["unkilled_same"] = int(not differences(expected, end_of(again)))
        while known["kills"] < kills:
            out = here / "killed"
            known["kills"] += killed([*command_of(recipe, here, out), *few], out, log, seconds, rng)
            differ = differences(expected, end_of(out))
            left = [p.name for p in out.rglob("*.partial")]
            known["runs"] += 1
            known["same"] += not differ and not left
            for key in [*differ, *left]:
                known["differ"][key] = known["differ"].get(key, 0) + 1
            shutil.rmtree(out)
            if short:
                break
    return known


# --- parts ----------------------------------------------------------------------------------------

SOUND = "a sound file"
RECIPES = ("imitate", "perpetual", "inbetween", "endless")
#: Kills of each recipe, in so many runs of other seeds.
KILLS, SEEDS = 26, (1, 2, 3, 4)


@case(SOUND)
def _(folder: Path) -> Any:
    return read(folder, "a.bvh", WALK.read_bytes())


def files_of(places: Places) -> list[str]:
    """The names of all hostile files, and of the sound one."""
    names = list(CASES)
    return [SOUND, names[0], "BVH, frame time 1e-310"] if places.smoke else names


def attacked(places: Places, unit: str) -> Any:
    """The outcome of one."""
    return outcome(unit)


def file_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Shares, and the slowest and the largest."""
    rows = [r for u, r in raws.items() if u != SOUND]
    values = {
        "read_or_refused_in_one_sentence": sum(r["ok"] for r in rows) / len(rows),
        "files_read": sum(r["outcome"] == "read" for r in rows),
        "files_refused": sum(r["outcome"] == "refused" for r in rows),
        "longest_cpu_s": max(r["cpu_s"] for r in rows),
        "most_memory_mb": max(r["peak_mb"] for r in rows),
    }
    yield from of("hostile files, runs and commands", values, len(rows))
    null = raws[SOUND]
    values = {"files_read": float(null["outcome"] == "read"), "longest_cpu_s": null["cpu_s"]}
    yield from of(SOUND, values, 1)


def kill_units(places: Places) -> list[str]:
    """Recipes and seeds."""
    return ["endless, seed 1"] if places.smoke else [f"{r}, seed {s}" for r in RECIPES for s in SEEDS]


def kills(places: Places, unit: str) -> Any:
    """Kills of one recipe."""
    recipe, _, seed = unit.partition(", seed ")
    return measure(recipe, 1 if places.smoke else KILLS, int(seed), places.smoke)


def kill_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """The share of runs that ended as one that was not killed; a run that nobody kills, made twice."""
    for recipe in dict.fromkeys(u.partition(",")[0] for u in raws):
        rows = [r for u, r in raws.items() if u.startswith(recipe)]
        runs, again = (sum(r[k] for r in rows) for k in ("runs", "unkilled_same"))
        values = {
            "same_as_without": sum(r["same"] for r in rows) / runs,
            "kills": sum(r["kills"] for r in rows),
        }
        yield from of(f"trainings killed and resumed: {recipe}", values, runs, seeds=len(rows))
        yield from of(
            f"trainings that nobody kills: {recipe}", {"same_as_without": again / len(rows)}, len(rows)
        )


PARTS = {
    "files": Part(
        "hostile files, runs and commands", files_of, attacked, file_rows, hours=0.4, needs=()
    ),
    "kills": Part("trainings killed and resumed", kill_units, kills, kill_rows, hours=3.0, needs=()),
}
