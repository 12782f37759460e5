"""How fast the engine is against its limit, and whether its physics is true.

python benchmarks/engine.py --json benchmarks/engine.json
python benchmarks/engine.py engine --against benchmarks/engine.json
python benchmarks/engine.py physics RUN --stable-pd
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from poise.cli.console import say, say_json, table, tell
from poise.cli.main import guarded
from poise.cli.options import Device, check_device
from poise.cli.parse import parse
from poise.errors import PoiseError
from poise.jobs.run_file import run_folder

if TYPE_CHECKING:
    from poise.recipes.imitation import Imitation

PROG = "benchmarks/engine.py"
What = Literal["all", "engine", "physics", "scaling", "latency"]
_ENVS, _GPU_ENVS = 512, 4096
Result = dict[str, Any]


@dataclass(frozen=True)
class Options:
    """Measure the engine against MuJoCo's own limit in the same run, its scaling, the latency of one
    character, or whether a policy keeps its score on finer physics."""

    what: Annotated[Positional[What], arg(metavar="WHAT")] = "all"
    """engine, scaling, latency, physics (which needs a RUN), or all of the first three."""
    run: Annotated[Positional[Path | None], arg(metavar="RUN")] = None
    """For physics: the folder of a result or of a run."""
    clip: Annotated[Path | None, arg(metavar="CLIP", help_behavior_hint="")] = None
    """The motion file to measure with; by default the walk that comes with Poise."""
    skeleton: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """The ASF skeleton of an AMC motion."""
    json: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Write the results as JSON; "-" prints JSON alone."""
    device: Device = "cpu"
    """cuda measures engine on an NVIDIA GPU, against mujoco_warp's own step."""
    against: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """An earlier JSON to compare shares and times with; nothing is judged by them."""
    envs: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Characters simulated at once in engine; by default 512, and 4096 on a GPU."""
    threads: Annotated[int, arg(metavar="N")] = 0
    """Threads of the physics in engine; 0 takes every core."""
    repeats: Annotated[int, arg(metavar="N")] = 5
    """Repetitions, of which medians are taken."""
    stable_pd: bool = False
    """For physics: also with the paper's explicit stable PD, which takes minutes."""


def run(options: Options, argv: Sequence[str]) -> int:
    """Measures, prints tables, saves JSON."""
    _check(options)
    before = None if options.against is None else _earlier(options.against)
    folder = None if options.run is None else run_folder(options.run)
    from speed import machine

    result: Result = {"command": " ".join([PROG, *argv]), "machine": machine()}
    if options.what == "physics":
        from speed import bench_physics

        assert folder is not None
        result["physics"] = bench_physics(folder, options.stable_pd, tell=_told)
    else:
        imitation = _imitation(options)
        chosen = {"gpu": _gpu} if options.device != "cpu" else _WORK
        for name, work in chosen.items():
            if options.what in ("all", name) or name == "gpu":
                result[name] = work(imitation, options)
    if options.json is not None and str(options.json) == "-":
        say_json(result)
        return 0
    for name, show in _SHOW.items():
        if name in result:
            show(result[name])
    if before is not None:
        _show_change(before, result)
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        say(str(options.json))
    return 0


def _check(options: Options) -> None:
    if (options.what == "physics") != (options.run is not None):
        what = "physics needs the folder of a run" if options.run is None else (
            f"only physics takes a run, got '{options.run}' for {options.what}"
        )  # fmt: skip
        raise PoiseError(
            what,
            hint="Write for example: python benchmarks/engine.py physics result",
            code="option-needs-option",
        )
    for name, low in (("envs", 1), ("threads", 0), ("repeats", 1)):
        value = getattr(options, name)
        if value is not None and value < low:
            raise PoiseError(f"--{name} must be at least {low}, got {value}", code="out-of-range")
    if options.device != "cpu" and options.what not in ("all", "engine"):
        raise PoiseError(
            f"{options.what} runs on the CPU alone",
            hint="Leave --device out",
            code="option-not-applicable",
        )
    check_device(options.device)


def _earlier(path: Path) -> Result:
    """What an earlier `--json` wrote."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as problem:
        raise PoiseError(f"cannot be compared with ({problem})", path, code="wrong-file-kind") from None
    if not isinstance(found, dict) or not any(name in found for name in _COMPARED):
        raise PoiseError(
            "holds no figures of this benchmark", path, "Make it with --json", code="wrong-file-kind"
        )
    return found


#: What is compared: shares of one run and times, which differ less between machines than rates do.
_COMPARED: dict[str, tuple[tuple[str, str], ...]] = {
    "engine": (
        ("stepping_of_raw", "stepping, share of raw"),
        ("training_of_raw", "training, share of raw"),
        ("raw_per_s", "raw control steps/s"),
        ("training_per_s", "training control steps/s"),
    ),
    "latency": (("ms", "one character, ms a control step"),),
}


def _show_change(before: Result, now: Result) -> None:
    rows = []
    for part, figures in _COMPARED.items():
        for key, name in figures:
            was, got = before.get(part, {}).get(key), now.get(part, {}).get(key)
            if was and got is not None:
                rows.append((name, f"{was:g}", f"{got:g}", f"{100 * (got / was - 1):+.0f} %"))
    table("compared with before", ("figure", "before", "now", "change"), rows)


def _imitation(options: Options) -> Imitation:
    import poise
    from poise.formats import read_clip
    from poise.recipes import ResidualForce, build

    path = options.clip or Path(poise.__file__).parent / "data" / "walk.bvh"
    envs = options.envs or (_ENVS if options.device == "cpu" else _GPU_ENVS)
    config = ResidualForce(help_limit=100.0, help_start=None, num_envs=envs)
    return build(read_clip(path, skeleton=options.skeleton), config)


def _told(what: str) -> None:
    tell(what, "dim")


def _engine(imitation: Imitation, options: Options) -> Result:
    from speed import bench_engine

    return bench_engine(imitation, options.threads, options.repeats, tell=_told)


def _gpu(imitation: Imitation, options: Options) -> Result:
    from speed import bench_gpu

    envs = imitation.config.num_envs
    return bench_gpu(imitation, envs, options.device, options.repeats, tell=_told)


def _scaling(imitation: Imitation, options: Options) -> list[Result]:
    from speed import bench_scaling

    return bench_scaling(imitation, repeats=min(3, options.repeats), tell=_told)


def _latency(imitation: Imitation, options: Options) -> Result:
    from speed import bench_latency

    return bench_latency(imitation)


_WORK: dict[str, Callable[[Imitation, Options], Any]] = {
    "engine": _engine,
    "scaling": _scaling,
    "latency": _latency,
}


def _show_engine(r: Result) -> None:
    title = (
        f"{r['envs']} characters on {r['threads']} threads, {r['rate_hz']:g} Hz {r['integrator']}, "
        f"{r['memory_mb']} MB"
    )
    rows = [
        ("MuJoCo's batch alone, state current", f"{r['raw_per_s']:,}", "1"),
        ("MuJoCo's batch alone, state one step behind", f"{r['raw_without_derived_per_s']:,}", "-"),
        ("stepping: observations, rewards, resets", f"{r['stepping_per_s']:,}", r["stepping_of_raw"]),
        ("training: collection and update", f"{r['training_per_s']:,}", r["training_of_raw"]),
    ]
    table(title, ("engine", "control steps/s", "of raw"), rows)
    phases = [(name, f"{100 * share:.0f} %") for name, share in r["training_phases"].items()]
    table("", ("training", "share of time"), phases)


def _show_gpu(r: Result) -> None:
    title = f"{r['envs']} characters on {r['device']}, {r['rate_hz']:g} Hz {r['integrator']}"
    rows = [
        ("mujoco_warp's step alone", f"{r['raw_per_s']:,.0f}", "1"),
        ("stepping: observations, rewards, resets", f"{r['stepping_per_s']:,.0f}", r["stepping_of_raw"]),
        ("training: collection and update", f"{r['training_per_s']:,.0f}", r["training_of_raw"]),
    ]
    table(title, ("gpu", "control steps/s", "of raw"), rows)


def _show_scaling(rows: list[Result]) -> None:
    columns = ("envs", "threads", "stepping/s", "raw/s", "of raw", "MB")
    keys = ("envs", "threads", "stepping_per_s", "raw_per_s", "stepping_of_raw", "memory_mb")
    table("scaling", columns, [[f"{r[k]:,}" for k in keys] for r in rows], left=0)


def _show_latency(r: Result) -> None:
    rows = [("one control step", f"{r['ms']:.3f}"), ("95 % are below", f"{r['ms_95']:.3f}")]
    rows += [(f"of it {name}", f"{ms:.3f}") for name, ms in r["phases_ms"].items()]
    helped = "with residual forces" if r["helped"] else "without residual forces"
    table(f"one character on one core, {helped}", ("latency", "ms"), rows)


def _show_physics(rows: list[Result]) -> None:
    columns = ("physics", "Hz", "integrator", "episodes", "succ", "mpjpe, mm", "reward")
    keys = ("physics", "rate_hz", "integrator", "episodes", "succ", "mpjpe_mm", "reward")
    table("one policy on coarse and fine physics", columns, [[r[k] for k in keys] for r in rows], left=3)


_SHOW: dict[str, Callable[[Any], None]] = {
    "engine": _show_engine,
    "gpu": _show_gpu,
    "scaling": _show_scaling,
    "latency": _show_latency,
    "physics": _show_physics,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the benchmark and returns the exit code."""
    given = sys.argv[1:] if argv is None else list(argv)
    return guarded(lambda: run(parse(Options, given, PROG), given))


if __name__ == "__main__":
    sys.exit(main())
