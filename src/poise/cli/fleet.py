"""`poise fleet`: a policy per clip, or a sweep, on this machine or on a Ray cluster."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, UseAppendAction, arg

from poise.cli.console import INTERRUPTED, Answer, say, table, tell
from poise.cli.options import Json, clips_in
from poise.cli.parse import parse
from poise.cli.training import clock
from poise.errors import PoiseError
from poise.jobs.keep import claimed
from poise.machine import cores

if TYPE_CHECKING:
    from poise.jobs.fleet import FleetJob, FleetResult, Record

#: Options of `poise imitate` that are not for a sweep, and what is instead.
_TAKEN = {
    "seed": "--seeds",
    "minutes": "--minutes",
    "threads": "--workers",
    "out": "-o",
    "resume": "nothing: a fleet always goes on",
    "set": "--set NAME=VALUE with a dot in the name, such as --set lfoot.kp=300,400",
}


@dataclass(frozen=True)
class Options:
    """Imitate every clip of a library, each with a policy of its own, and collect the results.

    Run it again to go on: what is done is skipped, what was stopped resumes."""

    library: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="LIBRARY ...", help_behavior_hint="(required)")
    ]
    """Folders of motion files, or motion files."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR")]
    """The folder of the results: fleet.json, and one folder per job as poise imitate writes it."""
    minutes: Annotated[float, arg(metavar="M")] = 10.0
    """Training time of each job in minutes."""
    seeds: Annotated[str, arg(metavar="S,S,...")] = "0"
    """Every clip is trained once with each of these seeds."""
    set: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME=V,V,...")] = ()
    """Values of an option of poise imitate (help-limit=0,50) or the body (lfoot.kp=300,400); every
    combination is a job."""
    workers: Annotated[int, arg(metavar="N")] = 0
    """Jobs at the same time, which share the cores evenly; 0 for one on each core."""
    address: Annotated[str | None, arg(metavar="ADDR", help_behavior_hint="")] = None
    """Run on a Ray cluster: HOST:PORT, ray://HOST:PORT, auto or local. Its machines must see the
    same files. By default the jobs run on this machine, without Ray."""

    json: Json = False


def run(options: Options, argv: Sequence[str]) -> Answer:
    """Exit code 0 if every job is done, 1 if one has failed, 130 after Ctrl-C."""
    o = options
    if o.workers < 0:
        raise PoiseError(
            f"--workers must be a whole number of at least 0, got {o.workers}", code="out-of-range"
        )
    jobs = plan(o)
    for job in jobs:
        _check(job)
    from poise.jobs.fleet import FLEET_FILE, read_table, run_fleet
    from poise.jobs.workers import make_workers

    with claimed(o.out):
        read_table(o.out)
        workers = make_workers(o.address, o.workers, len(jobs), cores())
    each = f"{workers.threads} core{'s' if workers.threads > 1 else ''}"
    say(f"{len(jobs)} job{'s' if len(jobs) > 1 else ''}, {workers.slots} at a time, {each} each")
    result = run_fleet(jobs, o.out, workers, on_event=_show)
    print_table(result)
    for record in result.records:
        if record.state == "failed":
            tell(f"{record.name} failed {record.attempts} times: {record.error}")
    keys = ("name", "state", "seconds", "attempts", "error", "score")
    jobs_done = [{key: getattr(r, key) for key in keys} for r in result.records]
    answer = Answer({"jobs": jobs_done}, {"table": o.out / FLEET_FILE})
    if result.interrupted:
        tell(f"Stopped; {result.count('done')} of {len(jobs)} jobs are done. Go on with:")
        tell(f"  {shlex.join(('poise', 'fleet', *argv))}")
        answer.exit_code = INTERRUPTED
    elif result.count("failed"):
        answer.exit_code = 1
    return answer


def plan(o: Options) -> list[FleetJob]:
    """One job for every clip, seed and combination of settings, in this order.

    Raises:
        PoiseError: no clip, or a seed or setting that cannot be understood.
    """
    from poise.jobs.fleet import FleetJob, combinations

    settings = dict(_setting(text) for text in o.set)
    seeds = _seeds(o.seeds)
    out, jobs = o.out.absolute(), []
    for label, path in clips_in(o.library, out):
        for seed in seeds:
            for chosen in combinations(settings):
                swept = [f"-{k}-{v}" for k, v in chosen.items() if len(settings[k]) > 1]
                name = label + (f"-s{seed}" if len(seeds) > 1 else "") + "".join(swept)
                name = "".join(c if c.isalnum() or c in "-_.+" else "_" for c in name)
                command = ["-m", "poise", "imitate", str(path), "-o", str(out / name), "--resume"]
                command += ["--minutes", f"{o.minutes:g}", "--seed", str(seed)]
                for key, value in chosen.items():
                    command += ["--set", f"{key}={value}"] if "." in key else [f"--{key}", value]
                facts = {"clip": str(path), "seed": seed, "set": chosen}
                jobs.append(FleetJob(name, tuple(command), out / name / "score.json", facts))
    return jobs


def _setting(text: str) -> tuple[str, list[str]]:
    name, equals, values = text.partition("=")
    name = name.strip().lstrip("-").replace("_", "-") if "." not in name else name.strip()
    listed = [v.strip() for v in values.split(",") if v.strip()]
    if not equals or not name or not listed:
        hint = "Write for example --set help-limit=0,50,100"
        raise PoiseError(
            f"--set needs NAME=VALUE or NAME=V,V,..., got '{text}'", hint=hint, code="option-malformed"
        )
    if name in _TAKEN:
        raise PoiseError(
            f"--set cannot set {name}", hint=f"Use {_TAKEN[name]}", code="option-not-applicable"
        )
    return name, listed


def _seeds(text: str) -> list[int]:
    parts = [p.strip() for p in text.split(",") if p.strip()]
    if not parts or not all(p.isdecimal() for p in parts) or len(set(parts)) != len(parts):
        hint = "Write for example --seeds 0,1,2"
        raise PoiseError(
            f"--seeds needs different whole numbers, got '{text}'", hint=hint, code="option-malformed"
        )
    return [int(p) for p in parts]


def _check(job: FleetJob) -> None:
    """Refuses what `poise imitate` would refuse, before anything runs."""
    from poise.cli.imitate import Options as Imitate
    from poise.cli.imitate import config_of

    # After -m poise imitate.
    config_of(parse(Imitate, job.command[3:], "poise imitate"))


def _show(event: str, record: Record) -> None:
    words = {
        "skipped": "was done before",
        "started": "started" if record.attempts == 1 else f"started again, attempt {record.attempts}",
        "again": f"failed and will be tried again: {record.error}",
        "failed": f"failed: {record.error}",
        "done": f"done in {clock(record.seconds)}",
    }
    figures = ""
    if event == "done" and record.score:
        figures = f", success {_percent(record)} %, joint error {_number(record, 'mpjpe_mm')} mm"
    tell(f"{record.name}: {words[event]}{figures}")


def print_table(result: FleetResult) -> None:
    """One row per job."""
    rows = [
        (
            r.name,
            r.state,
            _percent(r),
            _number(r, "mpjpe_mm"),
            _number(r, "help", "force_mean_n"),
            clock(r.seconds),
        )
        for r in result.records
    ]
    columns = ("job", "state", "success %", "joint error mm", "help N", "time")
    table("", columns, rows, left=2)


def _value(record: Record, *keys: str) -> float | None:
    found: Any = record.score or {}
    for key in keys:
        found = found.get(key) if isinstance(found, dict) else None
    return found if isinstance(found, int | float) else None


def _number(record: Record, *keys: str) -> str:
    value = _value(record, *keys)
    return "-" if value is None else f"{value:.4g}"


def _percent(record: Record) -> str:
    value = _value(record, "succ")
    return "-" if value is None else f"{100 * value:.4g}"
