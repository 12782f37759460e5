"""Table 3 of Perpetual Humanoid Control and what else its paper claims of the parts of its controller.

    python benchmarks/perpetual_ablations.py ... --collect

Measures every finished run of `perpetual_ablations.py` once, all clips from their first frames without
help (but for "uhc-helped"), beside "nothing", which is action 0. A row is above the one that it is
compared with by `RULE`, or that is "not shown". The runs of `perpetual_ablations.json` are judged
likewise, on noisy input too.
"""

from __future__ import annotations

import json
import statistics
from pathlib import Path
from typing import Any

import torch
from field.table import field_table
from torch import Tensor

from poise.eval.episodes import run_episodes
from poise.jobs.open import open_run
from poise.jobs.perpetual.result import RESULT
from poise.learn import LATEST, Policy, load_policy
from poise.recipes.imitation import Imitation

#: Of a run that was measured, in its folder.
ROW = "row.json"
#: Which row each is compared with.
AGAINST = {
    "relaxed": "plain", "multiplicative": "relaxed", "progressive": "multiplicative",
    "recovery": "progressive", "absolute-keypoints": "absolute-rotations",
    "no-energy": "relaxed", "style": "relaxed", "one-large-network": "relaxed",
    "means": "progressive", "primitives-1": "progressive", "primitives-3": "progressive",
    "primitives-4": "progressive", "uhc": "relaxed", "uhc-helped": "uhc",
}  # fmt: skip
RULE = (
    "A difference of the share of each clip until it fails is shown where it is more than twice the "
    "mean spread of the rows that have two seeds; without such rows nothing is shown."
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
        "clips": len(rows),
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
    row |= {"samples": seen, "nothing": measured(run.task, None)}
    stages = sorted(folder.glob("primitive-*.safetensors"))
    if stages:
        # What later networks still do of the clips that the first primitive did.
        each = [measured(run.task, load_policy(p, run.task.humanoid.identity))["done"] for p in stages]
        first = set(each[0])
        row["first_stage"] = [len(first & set(done)) for done in (*each, row["done"])]
    kept.write_text(json.dumps(row))
    return row


def judged(until: dict[str, list[float]]) -> dict[str, dict[str, Any]]:
    """Each row's difference to the one that it is compared with, and whether it is shown."""
    spreads = [max(v) - min(v) for v in until.values() if len(v) > 1]
    spread = statistics.fmean(spreads) if spreads else None
    out: dict[str, dict[str, Any]] = {}
    for name, other in AGAINST.items():
        if name in until and other in until:
            gap = statistics.fmean(until[name]) - statistics.fmean(until[other])
            shown = spread is not None and abs(gap) > 2 * spread
            out[name] = {"against": other, "difference": round(gap, 4), "seed_spread": spread}
            out[name]["verdict"] = "not shown" if not shown else "above" if gap > 0 else "below"
    return out


def _by_name(rows: dict[str, dict[str, Any]], key: str) -> dict[str, list[Any]]:
    out: dict[str, list[Any]] = {}
    for name, row in rows.items():
        out.setdefault(name.rpartition("-")[0], []).append(row[key])
    return out


def noisy(path: Path) -> dict[str, dict[str, list[float]]]:
    """strength -> row -> share until failure of each seed, of the runs in `perpetual_ablations.json`."""
    out: dict[str, dict[str, list[float]]] = {}
    for name, run in json.loads(path.read_text())["runs"].items() if path.exists() else ():
        row = name.removesuffix("-1")
        for rung in run["noise"]["rungs"]:
            out.setdefault(rung["name"], {}).setdefault(row, []).append(rung["tracked"])
    return out


def _percent(values: list[float]) -> str:
    return ", ".join(f"{100 * v:.0f}" for v in values)


def _said(verdict: dict[str, Any] | None) -> list[str]:
    if verdict is None:
        return ["", "", ""]
    return [verdict["against"], f"{100 * verdict['difference']:+.1f}", verdict["verdict"]]


def _row(*cells: object) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def _head(*names: str) -> list[str]:
    return [_row(*names), "|---" * len(names) + "|"]


def markdown(command: str, rows: dict[str, dict[str, Any]], earlier: dict[str, Any]) -> str:
    """All tables."""
    lines = ["# What the parts of the controller are worth", "", f"`{command}`", "", RULE, LEFT_OUT, ""]
    judgement = ("against", "difference", "")
    if rows:
        until = _by_name(rows, "until")
        verdicts, first = judged(until), next(iter(rows.values()))
        until["nothing"] = [first["nothing"]["until"]]
        lines += [
            f"{first['clips']} clips, {first['samples']:,} control steps each, seeds by commas.",
            "",
        ]
        figures = {"g_mpjpe": "g-MPJPE, mm", "acc": "acc, mm/frame²", "force_n": "help, N"}
        lines += _head("run", "clips done", "until it fails, %", *figures.values(), *judgement)
        for name, values in until.items():
            own = [r for n, r in rows.items() if n.rpartition("-")[0] == name] or [first["nothing"]]
            done = ", ".join(str(len(r["done"])) for r in own)
            shown = [", ".join(f"{r[k]:.1f}" for r in own) for k in figures]
            lines.append(_row(name, done, _percent(values), *shown, *_said(verdicts.get(name))))
        stages = {n: r["first_stage"] for n, r in rows.items() if "first_stage" in r}
        if stages:
            lines += [
                "",
                "Of the clips that the first primitive did, how many each primitive does when its",
            ]
            lines += ["stage ends, and at last the composer:", "", *_head("run", "clips")]
            lines += [_row(n, ", ".join(map(str, s))) for n, s in stages.items()]
    for strength, table in earlier.items():
        verdicts = judged(table)
        lines += ["", f"## Runs of `perpetual_ablations.json`, noise: {strength}", ""]
        lines += _head("run", "until it fails, %", *judgement)
        lines += [_row(n, _percent(v), *_said(verdicts.get(n))) for n, v in table.items()]
    return "\n".join(lines) + "\n"


def write(folder: Path, samples: int, out: Path) -> None:
    """JSON and tables of all finished runs in a folder."""
    found = {p.name: row_of(p, samples) for p in sorted(folder.iterdir()) if (p / LATEST).exists()}
    rows = {n: r for n, r in found.items() if r is not None}
    earlier = noisy(Path(__file__).with_name("perpetual_ablations.json"))
    command = (
        "python benchmarks/perpetual_ablations.py --library FOLDER --onto FILE -o RUNS "
        f"--samples {samples} --only {' '.join(dict.fromkeys(n.rpartition('-')[0] for n in rows))}"
    )
    data = {
        "command": command, "rule": RULE, "verdicts": judged(_by_name(rows, "until")),
        "noise": {s: {"tracked": t, "verdicts": judged(t)} for s, t in earlier.items()}, "runs": rows,
    }  # fmt: skip
    out.write_text(json.dumps(data, indent=1) + "\n")
    out.with_suffix(".md").write_text(markdown(command, rows, earlier))
