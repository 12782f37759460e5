"""Table 3 of Perpetual Humanoid Control and what else its paper claims of the parts of its controller.

    python benchmarks/perpetual_ablations.py ... --collect

Measures every finished run of `perpetual_ablations.py` once, all clips from their first frames without
help (but for "uhc-helped"), beside "nothing", which is action 0. A row is above the one that it is
compared with, or above nothing, by `RULE`, or that is "not shown". The runs that are kept in
`perpetual_ablations.json` are judged likewise, on noisy input too.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from field.table import field_table
from torch import Tensor

from poise.jobs.open import open_run
from poise.jobs.perpetual.perpetual_run import RESULT
from poise.learn import LATEST, Policy, load_policy
from poise.recipes.imitation import Imitation
from poise.score.episodes import run_episodes

#: Of a run that was measured, in its folder.
ROW = "row.json"
#: Which row each is compared with.
AGAINST = {
    "relaxed": "plain", "multiplicative": "relaxed", "progressive": "multiplicative",
    "recovery": "progressive", "absolute-keypoints": "absolute-rotations",
    "no-energy": "relaxed", "style": "relaxed", "one-large-network": "relaxed",
    "means": "progressive", "primitives-1": "progressive", "primitives-3": "progressive",
    "primitives-4": "progressive", "uhc": "relaxed", "uhc-helped": "uhc",
    "heading": "bare", "window": "bare", "filter": "bare", "root": "bare", "prices": "bare",
    "own-bodies": "bare", "as-shipped": "bare", "together": "bare",
    "taught": "longer", "taught-ppo": "longer",
}  # fmt: skip
RULE = (
    "A difference of the share of each clip until it fails is shown where it is more than twice the "
    "mean spread of the rows of its table that have two seeds; without such rows nothing is shown."
)
#: What the paper compares and no setting does.
LEFT_OUT = "Not measured: top-1 mixture of experts (no setting; `means` is the code's mixture)."


class Nothing:
    """Action 0, which aims at the motion's own joint angles."""

    def __init__(self, num_obs: int, num_actions: int):
        self.num_obs, self.num_actions = num_obs, num_actions

    def act(self, obs: Tensor) -> Tensor:
        return torch.zeros(len(obs), self.num_actions)


def measured(task: Imitation, policy: Policy | None, helped: bool = False) -> dict[str, Any]:
    """Every clip from its first frame: how many are done, the share until each fails, errors in mm."""
    scale, bare = float(helped), task.bare()
    if policy is None:
        env = bare.env(1, threads=1)
        policy = Nothing(env.num_obs, env.num_actions)
        env.close()
    every = torch.arange(len(task.reference.length))
    rollouts, _ = run_episodes(
        lambda n: bare.env(n, None, False, 1, help_scale=scale, guard=False),
        policy, every, torch.zeros_like(every), cycles=1,
    )  # fmt: skip
    table = field_table(rollouts)
    rows = {c.clip: c for c in table.clips}
    steps = dict(zip(task.reference.names, (task.reference.length - 1).tolist(), strict=True))
    return {
        "steps": steps,
        "done": [n for n, c in rows.items() if not c.failed],
        "until": statistics.fmean(min(1.0, c.frames / steps[n]) for n, c in rows.items()),
        "g_mpjpe": table.views["all_frame"].g_mpjpe,
        "acc": table.views["all_frame"].acc,
        "force_n": float(rollouts.force.norm(dim=-1).sum(-1)[rollouts.alive].mean()) if helped else 0.0,
    }


def row_of(folder: Path, samples: int) -> dict[str, Any] | None:
    """What a finished run has come to, measured once; None where it is not finished."""
    kept = folder / ROW
    if kept.exists():
        return json.loads(kept.read_text())
    seen = int(load_policy(folder / LATEST).meta["samples"])
    uhc = folder.name.startswith("uhc")
    if not (seen >= samples if uhc else (folder / RESULT).exists()):
        return None
    run = open_run(folder)
    row = measured(run.task, run.policy, folder.name.startswith("uhc-helped"))
    row["samples"] = seen
    stages = sorted(folder.glob("primitive-*.safetensors"))
    if stages:
        # What later networks still do of the clips that the first primitive did.
        each = [measured(run.task, load_policy(p, run.task.humanoid.identity))["done"] for p in stages]
        first = set(each[0])
        row["first_stage"] = [len(first & set(done)) for done in (*each, row["done"])]
    kept.write_text(json.dumps(row))
    return row


def judged(until: dict[str, list[float]], null: float | None = None) -> dict[str, dict[str, Any]]:
    """Each row's difference to the one that it is compared with and to nothing, and what is shown."""
    spreads = [max(v) - min(v) for v in until.values() if len(v) > 1]
    spread = statistics.fmean(spreads) if spreads else None

    def verdict(gap: float) -> str:
        shown = spread is not None and abs(gap) > 2 * spread
        return "not shown" if not shown else "above" if gap > 0 else "below"

    out: dict[str, dict[str, Any]] = {}
    for name, values in until.items():
        own, other = statistics.fmean(values), AGAINST.get(name)
        row: dict[str, Any] = {"seed_spread": spread}
        if other in until:
            gap = own - statistics.fmean(until[other])
            row |= {"against": other, "difference": round(gap, 4), "verdict": verdict(gap)}
        if null is not None:
            row |= {"to_nothing": round(own - null, 4), "verdict_nothing": verdict(own - null)}
        out[name] = row
    return out


def _by_name(rows: dict[str, dict[str, Any]], key: str) -> dict[str, list[Any]]:
    out: dict[str, list[Any]] = {}
    for name, row in rows.items():
        out.setdefault(name.rpartition("-")[0], []).append(row[key])
    return out


def earlier(path: Path, steps: dict[str, int]) -> dict[str, dict[str, Any]]:
    """The runs in `perpetual_ablations.json` as rows."""
    out: dict[str, dict[str, Any]] = {}
    for name, run in json.loads(path.read_text())["runs"].items() if path.exists() else ():
        library = run["table"]["library"]
        shares = [min(1.0, c["frames"] / steps[c["clip"]]) for c in library["clips"]]
        out[name if name.endswith("-1") else f"{name}-0"] = {
            "done": [c["clip"] for c in library["clips"] if not c["failed"]],
            "until": statistics.fmean(shares), "samples": run["about"]["samples"], "force_n": 0.0,
            **{k: library["views"]["all_frame"][k] for k in ("g_mpjpe", "acc")},
            "noise": {rung["name"]: rung["tracked"] for rung in run["noise"]["rungs"]},
        }  # fmt: skip
    return out


def _percent(values: list[float]) -> str:
    return ", ".join(f"{100 * v:.0f}" for v in values)


def _said(verdict: dict[str, Any]) -> list[str]:
    """Cells of one row's judgement."""
    cells = []
    for other, gap, said in (
        ("against", "difference", "verdict"),
        ("", "to_nothing", "verdict_nothing"),
    ):
        if gap in verdict:
            told = (verdict.get(other, ""), f"{100 * verdict[gap]:+.1f}", verdict[said])
            cells.append(" ".join(told).strip())
        else:
            cells.append("")
    return cells


def _row(*cells: object) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def _head(*names: str) -> list[str]:
    return [_row(*names), "|---" * len(names) + "|"]


def _table(rows: dict[str, dict[str, Any]], null: dict[str, Any]) -> list[str]:
    """Runs of equal samples beside nothing."""
    until = _by_name(rows, "until")
    verdicts = judged(until, null["until"])
    figures = {"g_mpjpe": "g-MPJPE, mm", "acc": "acc, mm/frame²", "force_n": "help, N"}
    lines = _head(
        "run", "clips done", "until it fails, %", *figures.values(), "difference to", "to nothing"
    )
    for name, values in until.items():
        own = [r for n, r in rows.items() if n.rpartition("-")[0] == name]
        done = ", ".join(str(len(r["done"])) for r in own)
        shown = [", ".join(f"{r[k]:.1f}" for r in own) for k in figures]
        lines.append(_row(name, done, _percent(values), *shown, *_said(verdicts[name])))
    shown = [f"{null[k]:.1f}" for k in figures]
    return [*lines, _row("nothing", len(null["done"]), _percent([null["until"]]), *shown, "", "")]


def markdown(
    command: str,
    rows: dict[str, Any],
    before: dict[str, Any],
    null: dict[str, Any],
    minutes: float | None = None,
) -> str:
    """All tables. rows: of runs at hand. before: of those that are kept in the other file. minutes: of
    rows that are equal in time."""
    lines = ["# What the parts of the controller are worth", "", f"`{command}`", "", RULE, LEFT_OUT]
    lines += [f"{len(null['steps'])} clips, seeds by commas; percent and points of the clip."]
    for title, table in (("Runs", rows), ("Runs of `perpetual_ablations.json`", before)):
        if table:
            equal = f"{next(iter(table.values()))['samples']:,} control steps"
            if minutes is not None:
                equal = f"{minutes:g} minutes of a core"
            lines += ["", f"## {title}, {equal} each", "", *_table(table, null)]
    stages = {n: r["first_stage"] for n, r in rows.items() if "first_stage" in r}
    if stages:
        lines += ["", "Of the clips that the first primitive did, how many each primitive does when its"]
        lines += ["stage ends, and at last the composer:", "", *_head("run", "clips")]
        lines += [_row(n, ", ".join(map(str, s))) for n, s in stages.items()]
    for strength, until in noisy(before).items():
        verdicts = judged(until)
        lines += ["", f"## The same, noise: {strength}", ""]
        lines += _head("run", "until it fails, %", "difference to")
        lines += [_row(n, _percent(v), _said(verdicts[n])[0]) for n, v in until.items()]
    return "\n".join(lines) + "\n"


def noisy(before: dict[str, dict[str, Any]]) -> dict[str, dict[str, list[float]]]:
    """strength -> row -> share until failure of each seed."""
    noises = _by_name(before, "noise")
    strengths = dict.fromkeys(s for runs in noises.values() for run in runs for s in run)
    return {s: {n: [run[s] for run in runs] for n, runs in noises.items()} for s in strengths}


def null_of(task: Callable[[], Imitation], kept: Path) -> dict[str, Any]:
    """What doing nothing comes to, measured once."""
    if not kept.exists():
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps(measured(task(), None)))
    return json.loads(kept.read_text())


def write(
    folder: Path,
    samples: int,
    null: dict[str, Any],
    out: Path,
    kept: bool = True,
    minutes: float | None = None,
) -> None:
    """JSON and tables of all finished runs in a folder, and of those in `perpetual_ablations.json`.

    kept: False leaves the latter out. minutes: that each run took, in place of samples.
    """
    runs = [p for p in sorted(folder.iterdir()) if (p / LATEST).exists() or (p / ROW).exists()]
    found = {p.name: row_of(p, samples) for p in runs}
    rows = {n: r for n, r in found.items() if r is not None}
    path = Path(__file__).with_name("perpetual_ablations.json")
    before = earlier(path, null["steps"]) if kept else {}
    command = "python benchmarks/perpetual_ablations.py --library FOLDER --onto FILE -o RUNS "
    command += f"--samples {samples}" if minutes is None else f"--from RUN --minutes {minutes:g}"
    if rows:
        command += f" --only {' '.join(dict.fromkeys(n.rpartition('-')[0] for n in rows))}"
    data = {
        "command": command, "rule": RULE, "nothing": null,
        "verdicts": judged(_by_name(rows, "until"), null["until"]), "runs": rows,
        "earlier": {"verdicts": judged(_by_name(before, "until"), null["until"]), "runs": before},
        "noise": {s: judged(until) for s, until in noisy(before).items()},
    }  # fmt: skip
    out.write_text(json.dumps(data, indent=1) + "\n")
    out.with_suffix(".md").write_text(markdown(command, rows, before, null, minutes))
