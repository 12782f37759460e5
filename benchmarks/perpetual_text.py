"""The results of `perpetual.py` as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from field.card import FieldTable, markdown
from field.paper import PHC_RECOVERY, paper_rows
from field.sources import source_table
from perpetual_curves import at_samples

#: What must be said beside every comparison with the paper.
DIFFERENCE = (
    "Not the paper's data: PHC trains on 11,313 sequences of AMASS's train split with a "
    "SMPL body of 24 rigid bodies in Isaac Gym and tests on 140 sequences of AMASS's test split; here "
    "the clips, the body and the simulator (MuJoCo) are those named above. Figures beside each other "
    "show the size of things, not a ranking."
)
WORST = 10


def report(result: Mapping[str, Any]) -> str:
    """The whole report."""
    runs: Mapping[str, Any] = result["runs"]
    out = ["# One policy for a library: measured", "", f"`{result['command']}`", ""]
    out += [_machine(result["machine"]), ""]
    if len(runs) > 1:
        out += ["## Side by side", "", side_by_side(runs), ""]
    for name, parts in runs.items():
        out += [f"## {name}", "", *about(parts["about"]), ""]
        for part, write in _PARTS:
            if part in parts:
                out += write(parts[part]) if "skipped" not in parts[part] else [_skipped(part, parts)]
                out.append("")
    return "\n".join(out).rstrip() + "\n"


def about(a: Mapping[str, Any]) -> list[str]:
    """What was trained on what, and what it cost."""
    b, subjects = a["body"], ", ".join(a["subjects"][:12])
    more = f" and {len(a['subjects']) - 12} more" if len(a["subjects"]) > 12 else ""
    state = "finished" if a["finished"] else f"unfinished, help of up to {a['help_n']:.0f} N left"
    return [
        f"{a['clips']} clips, {a['minutes_of_motion']:.1f} minutes ({subjects}{more}). Body: "
        f"{b['bodies']} bodies, {b['hinges']} hinges, {b['mass_kg']:g} kg, {b['height_m']:g} m. "
        f"{_network(a)}, "
        f"{a['policy_numbers']:,} numbers; {state}.",
        "",
        _lines(
            [("samples", "training time", "hardware of the training"),
             (f"{a['samples']:,}", _clock(a["seconds"]), a["hardware"])]
        ),
    ]  # fmt: skip


def _network(a: Mapping[str, Any]) -> str:
    k = a["primitives"]
    plural = "s" if k > 1 else ""
    return f"{k} primitive{plural}, stage {a['stage']}" if k else "One network"


def side_by_side(runs: Mapping[str, Any]) -> str:
    """One row per run, and how far each was after the samples of the shortest."""
    least = min(p["about"]["samples"] for p in runs.values())
    head = ["run", "samples", "time", "hardware", "library Succ %", "g-MPJPE mm", "held-out Succ %",
            "g-MPJPE mm", "noisy Succ %", "video noise x1 Succ %", f"all clips at {least:,} samples",
            "fallen 10 s", "far 10 s", "both 10 s"]  # fmt: skip
    rows: list[Sequence[str]] = [head]
    for name, p in runs.items():
        a = p["about"]
        cells = [name, f"{a['samples']:,}", _clock(a["seconds"]), a["hardware"]]
        for part, key in (("table", "library"), ("table", "held_out")):
            t = p.get(part, {}).get(key)
            error = t["views"]["all_frame"]["g_mpjpe"] if t else None
            cells += [_percent(t["succ"]) if t else "-", _number(error)]
        t = p.get("noisy", {}).get("table")
        cells.append(_percent(t["succ"]) if t else "-")
        rungs = [r for r in p.get("noise", {}).get("rungs", ()) if r["name"] == "all x1"]
        cells.append(_percent(rungs[0]["succ"]) if rungs else "-")
        seen = at_samples(p["curves"], least, a["clips"]) if "curves" in p else None
        cells.append(
            "-" if seen is None
            else f"{seen['succeeded']} of {seen['clips']}, help {seen['help_n']:.0f} N "
                 f"({seen['samples']:,})"
        )  # fmt: skip
        for kind in ("fallen", "far", "fallen and far"):
            row = p.get("recovery", {}).get("kinds", {}).get(kind)
            cells.append(_percent(row["within"][-1]) if row else "-")
        rows.append(cells)
    spread = max(p["about"]["samples"] for p in runs.values()) / max(1, least)
    said = (
        "All runs had the same samples to within 2 %."
        if spread <= 1.02
        else f"The runs had different samples, by up to a factor of {spread:.2f}; the column of "
        f"{least:,} samples holds the latest evaluation of the whole library by then (with the samples "
        "at which it was made and the help of that moment)."
    )
    return _lines(rows) + "\n\n" + said


def _table(part: Mapping[str, Any]) -> list[str]:
    kinds = ("held_out", "held_out_nothing", "library", "library_nothing", "library_made")
    tables = [FieldTable.from_dict(part[k]) for k in kinds if part.get(k)]
    paper = paper_rows("AMASS-Train", "AMASS-Test")
    out = ["### Tracking, without help", "", markdown(tables, paper, WORST).rstrip(), "", DIFFERENCE]
    out += ["", "By source, errors by clip:", "", source_table(tables)]
    if part.get("held_out_subjects"):
        out += ["", f"Held out: {', '.join(part['held_out_subjects'])}."]
    if part.get("bodies"):
        rows: list[Sequence[str]] = [("body", "kg", "m", "clips", "Succ %", "g-MPJPE mm")]
        for b in part["bodies"]:
            size = (f"{b['mass_kg']:g}", f"{b['height_m']:g}", str(b["clips"]))
            rows.append((str(b["body"]), *size, _percent(b["succ"]), _number(b["g_mpjpe"])))
        out += ["", "The library body by body:", "", _lines(rows)]
    return out + ([""] if part.get("notes") else []) + [f"- {n}" for n in part.get("notes", ())]


def _search(part: Mapping[str, Any]) -> list[str]:
    kinds = [part[k] for k in ("held_out", "library") if k in part]
    tables = [FieldTable.from_dict(k["table"]) for k in kinds]
    out = ["### What is searched", ""]
    for k, t in zip(kinds, tables, strict=True):
        one = k["seconds_of_a_second"]
        took = (
            "" if one is None else f" {one:.1f} s for 1 s of motion on {k['threads']} threads (median)."
        )
        out += [
            f"{t.data}: the policy alone does {k['alone']} of {k['alone'] + k['searched']} clips, "
            f"{k['found']} of the other {k['searched']} were found by {k['characters']} characters, "
            f"without help.{took}", "",
        ]  # fmt: skip
    return [*out, markdown(tables, (), WORST).rstrip()]


def _recovery(part: Mapping[str, Any]) -> list[str]:
    rows: list[Sequence[str]] = [
        ("start", "trials", "Succ-5s", "Succ-10s", "median s", "slowest s", "paper 5 s", "paper 10 s")
    ]
    told = {r.start: r for r in PHC_RECOVERY if r.method == "PHC"}
    card: Mapping[str, Any] = {}
    for kind, card in part["kinds"].items():
        p = told[kind]
        ends = (
            _number(card["median"]),
            _number(card["slowest"]),
            f"{p.succ_5s:.1f}",
            f"{p.succ_10s:.1f}",
        )
        rows.append((kind, str(card["trials"]), *(_percent(x) for x in card["within"]), *ends))
    learned = (
        "A recovery clip leads a character back that has lost the reference; training had such clips."
        if card.get("ways")
        else "Recovery was part of the training."
        if card.get("learned")
        else "This policy was never trained to recover."
    )
    return [
        "### Recovery", "", _lines(rows), "",
        f"Reference: a body that {part['reference'].replace('standing', 'stands')}. Back: bodies "
        f"on average within {card.get('near', 0.5):g} m for {card.get('held', 0.5):g} s; far is 3 m. "
        f"The paper does not say what counts as back. {learned}",
    ]  # fmt: skip


def _owners(part: Mapping[str, Any]) -> list[str]:
    rows: list[Sequence[str]] = [
        ("primitive", "clips it owns", "it does", "best primitive does", "composer does", "lost",
         "composer - owner mm", "composer - best mm")
    ]  # fmt: skip
    for s in part["summary"]:
        rows.append((
            str(s["primitive"]), *(str(s[k]) for k in ("clips", "owner", "best", "composer")),
            ", ".join(s["lost"]) or "none", _number(s["worse_mm"]), _number(s["worse_best_mm"]),
        ))  # fmt: skip
    worse = [r for r in part["per_clip"] if r["best_succeeded"] and not r["composer_succeeded"]]
    done = sum(r["best_succeeded"] for r in part["per_clip"])
    said = (
        f"The composer does all of the {done} clips that some primitive does."
        if not worse
        else f"{len(worse)} clips that a primitive does, the composer does not: "
        + ", ".join(r["clip"] for r in worse[:WORST])
        + ("." if len(worse) <= WORST else ", ...")
    )
    return ["### Composer and primitives", "", _lines(rows), "", said]


def _noise(part: Mapping[str, Any]) -> list[str]:
    rows: list[Sequence[str]] = [
        ("noise", "clips", "Succ % of what came in", "Succ % of the true motion", "error mm",
         "off the true motion mm", "noise mm")
    ]  # fmt: skip
    for r in part["rungs"]:
        figures = (_number(r[k]) for k in ("mpjpe_mm", "off_mm", "noise_mm"))
        shares = (_percent(r["succ"]), _percent(r["succ_clean"]))
        rows.append((r["name"], str(r["motions"]), *shares, *figures))
    more = [f"- {r['motion']} at {r['level']}: {r['why']}" for r in part["refused"]]
    return ["### Noisy input", "", _lines(rows), *([""] if more else []), *more]


def _noisy(part: Mapping[str, Any]) -> list[str]:
    table = markdown(FieldTable.from_dict(part["table"]), paper_rows("H36M-Test-Video, noisy"), WORST)
    out = ["### Real estimators' files", "", table.rstrip(), "",
           "Errors are against what came in. The paper's video set is another one."]  # fmt: skip
    return out + [f"- not tracked: {r['file']}: {r['why']}" for r in part["refused"]]


def _speed(part: Mapping[str, Any]) -> list[str]:
    one = part["one"]
    phases = (f"{one['phases_ms'][k]:.2f}" for k in ("policy", "physics", "observation"))
    rows: list[Sequence[str]] = [
        ("", "ms a control step", "slowest 5 %", "processor ms", "policy", "physics", "observation"),
        ("1 character, 1 thread", f"{one['ms']:.2f}", f"{one['ms_95']:.2f}", "", *phases),
    ]  # fmt: skip
    for m in part["crowds"]:
        what = f"{m['characters']} in one world, {m['threads']} thread{'s' if m['threads'] > 1 else ''}"
        times = (f"{m['ms']:.2f} ({m['hz']:.0f} Hz)", f"{m['ms_95']:.2f} ({m['hz_95']:.0f} Hz)")
        rows.append((what, *times, f"{m['cpu_ms']:.2f}", "", "", ""))
    return ["### Real time", "", _lines(rows), "", _machine(part["machine"])]


def _curves(part: Mapping[str, Any]) -> list[str]:
    rows: list[Sequence[str]] = [
        ("stage", "begins at samples", "evaluations", "last: clips", "succeed", "mm", "help N",
         "trials", "back")
    ]  # fmt: skip
    for stage in part["stages"]:
        own = [r for r in part["evaluations"] if r["name"] == stage["stage"]]
        last = own[-1] if own else None
        figures = (
            ("-",) * 4 if last is None else
            (*(str(last[k]) for k in ("clips", "succeeded")), f"{last['error_mm']:.0f}",
             f"{last['help_n']:.0f}")
        )  # fmt: skip
        tried = [r for r in part["recoveries"] if r["name"] == stage["stage"]]
        back = tuple(str(tried[-1][k]) for k in ("trials", "recovered")) if tried else ("-", "-")
        made = str(max(len(own), len(tried)))
        rows.append((stage["stage"], f"{stage['from_samples']:,}", made, *figures, *back))
    out = ["### Learning", "", f"![Learning curves]({part['image']})", "", _lines(rows)]
    return out + _along(part["evaluations"])


def _along(evaluations: Sequence[Mapping[str, Any]]) -> list[str]:
    """Success by source at up to eight evaluations from the first to the last."""
    told = [r for r in evaluations if len(r.get("sources", ())) > 1]
    if not told:
        return []
    last = len(told) - 1
    picked = [told[k] for k in sorted({round(last * i / 7) for i in range(8)})]
    sources = list(dict.fromkeys(s for r in picked for s in r["sources"]))
    rows: list[Sequence[str]] = [("samples", *sources)]
    for r in picked:
        cells = (" of ".join(map(str, r["sources"].get(s, ("-",)))) for s in sources)
        rows.append((f"{r['samples']:,}", *cells))
    return ["", "Clips that succeed, by source:", "", _lines(rows)]


def _skipped(part: str, parts: Mapping[str, Any]) -> str:
    return f"No {part}: {parts[part]['skipped']}."


def _machine(m: Mapping[str, Any]) -> str:
    return (
        f"Measured on {m['cores']} cores ({m['machine']}), MuJoCo {m['mujoco']}, PyTorch {m['torch']}, "
        f"load {m['load_before']} at the beginning."
    )


def _lines(rows: Sequence[Sequence[str]]) -> str:
    lines = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _percent(x: float | None) -> str:
    return "-" if x is None else f"{100 * x:.1f}"


def _number(x: float | None) -> str:
    return "-" if x is None else f"{x:.1f}"


def _clock(seconds: float) -> str:
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"


_PARTS = (
    ("table", _table), ("search", _search), ("recovery", _recovery), ("owners", _owners),
    ("noise", _noise), ("noisy", _noisy), ("speed", _speed), ("curves", _curves),
)  # fmt: skip
