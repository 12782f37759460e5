"""The model card of a trained tracker: what it is, what it was made of, what it can and cannot do.

Made of the results of `benchmarks/perpetual.py` alone, so that no figure is written by hand.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from field.card import FieldTable, markdown
from field.paper import PHC_RECOVERY, paper_rows
from poise.errors import PoiseError

#: Subjects that are named one by one.
NAMED = 60


def model_card(
    parts: Mapping[str, Any],
    licences: Mapping[str, str] | None = None,
    image: str = "",
    title: str = "Tracker",
) -> str:
    """The card as Markdown.

    Args:
        parts: one run of `perpetual.json`; of its parts "about" is needed, the others are told where
            they were measured, and named as not measured where not.
        licences: data set to its licence; without any the card says that none is stated.
        image: of the learning curves, as the card links to it; none for none.

    Raises:
        PoiseError: no results of a run.
    """
    if "about" not in parts:
        raise PoiseError(
            "a model card needs the results of a run", hint="Measure it first", code="argument-missing"
        )
    about = parts["about"]
    sections = [
        [f"# {title}"],
        _summary(about),
        _data(about, parts, licences or {}),
        _training(about, parts, image),
        _figures(parts),
        _limits(about, parts),
    ]
    return "\n\n".join("\n".join(lines) for lines in sections) + "\n"


def _summary(a: Mapping[str, Any]) -> list[str]:
    body, k = a["body"], a["primitives"]
    network = f"{k} primitives and their composer" if k and a["stage"] == "composer" else "one network"
    goal = "body places and rotations" if a["config"]["goal"] == "rotations" else "body places alone"
    state = "" if a["finished"] else " **The training is not finished.**"
    return [
        f"A physics-based controller ({network}, {a['policy_numbers']:,} numbers) that tracks human "
        f"motion from {goal}, one frame ahead, at {a['config']['sim']['control_hz']:g} Hz; policy "
        f"`{a['policy']}`.{state}",
        "",
        f"Body `{body['identity']}`: {body['bodies']} rigid bodies, {body['hinges']} hinges, "
        f"{body['mass_kg']:g} kg, {body['height_m']:g} m. The weights fit no other body.",
        "",
        "Help at test time: none. Every figure below is that of the character alone.",
    ]


def _data(a: Mapping[str, Any], parts: Mapping[str, Any], licences: Mapping[str, str]) -> list[str]:
    named = ", ".join(a["subjects"][:NAMED])
    more = f" and {len(a['subjects']) - NAMED} more" if len(a["subjects"]) > NAMED else ""
    held = parts.get("table", {}).get("held_out_subjects", [])
    out = [
        "## Data", "",
        f"Learned: {a['clips']} clips, {a['minutes_of_motion']:.1f} minutes, of {named}{more}.", "",
        "Held out of the training: " + (", ".join(held) if held else "nothing was measured") + ".", "",
    ]  # fmt: skip
    if not licences:
        return [*out, "Licences of the data: not stated."]
    return [*out, "| data | licence |", "|---|---|", *(f"| {d} | {t} |" for d, t in licences.items())]


def _training(a: Mapping[str, Any], parts: Mapping[str, Any], image: str) -> list[str]:
    hours = a["seconds"] / 3600
    out = [
        "## Training", "",
        f"{a['samples']:,} control steps in {hours:.2f} hours on: {a['hardware']}. Seed "
        f"{a['config']['seed']}.",
    ]  # fmt: skip
    curve = parts.get("curves")
    if curve:
        stages = "; ".join(f"{s['stage']} from {s['from_samples']:,}" for s in curve["stages"])
        out += ["", f"Stages by samples: {stages}."]
    if image:
        out += ["", f"![Learning curves]({image})"]
    return out


def _figures(parts: Mapping[str, Any]) -> list[str]:
    out = ["## Figures", ""]
    table = parts.get("table", {})
    kinds = ("held_out", "library", "library_made")
    tables = [FieldTable.from_dict(table[k]) for k in kinds if table.get(k)]
    if tables:
        said = "The paper's rows are on other data, another body and another simulator."
        paper = [r for r in paper_rows("AMASS-Train", "AMASS-Test") if r.method.startswith("PHC")]
        out += [markdown(tables, paper).rstrip(), "", said, ""]
    out += [_searched(p) for k in ("held_out", "library") if (p := parts.get("search", {}).get(k))]
    noisy = parts.get("noisy", {}).get("table")
    if noisy:
        out.append(f"- Files of real pose estimators: {_share(noisy['succ'])} of {noisy['episodes']}.")
    told = {r.start: r for r in PHC_RECOVERY if r.method == "PHC"}
    for kind, row in parts.get("recovery", {}).get("kinds", {}).items():
        shares = " and ".join(_share(x) for x in row["within"])
        paper = f"{told[kind].succ_5s:.1f} and {told[kind].succ_10s:.1f} %"
        out.append(
            f"- Recovery, {kind}: {shares} back in 5 and 10 s, {row['trials']} trials (PHC: {paper})."
        )
    speed = parts.get("speed")
    if speed:
        one = speed["one"]
        out.append(
            f"- One character: {one['ms']:.2f} ms a control step on one core (policy "
            f"{one['phases_ms']['policy']:.2f}, physics {one['phases_ms']['physics']:.2f})."
        )
        out += [
            f"- {m['characters']} characters in one world on {m['threads']} threads: {m['hz']:.0f} Hz."
            for m in speed["crowds"] if m["characters"] > 1
        ]  # fmt: skip
    asked = ("table", "search", "recovery", "noise", "noisy", "speed", "curves")
    missing = [p for p in asked if p not in parts or "skipped" in parts[p]]
    if missing:
        out += ["", f"Not measured: {', '.join(missing)}."]
    return out


def _searched(part: Mapping[str, Any]) -> str:
    t, error = part["table"], part["table"]["views"]["all_frame"]["g_mpjpe"]
    return (
        f"- Searched, {t['data']}: {_share(t['succ'])} of {t['episodes']} clips, {error:.0f} mm. "
        f"{part['found']} of the {part['searched']} that it loses alone were found by "
        f"{part['characters']} characters at once, without help; no controller, see docs/track.md."
    )


def _limits(a: Mapping[str, Any], parts: Mapping[str, Any]) -> list[str]:
    """What the settings and the figures say that it cannot do."""
    config, out = a["config"], []
    held = parts.get("table", {}).get("held_out")
    if held:
        lost = [c["clip"] for c in held["clips"] if c["failed"]]
        share = f"{len(lost)} of {len(held['clips'])} held-out clips fail"
        out.append(f"- {share}: {', '.join(lost[:12])}{', ...' if len(lost) > 12 else ''}." if lost else
                   f"- {share}.")  # fmt: skip
    else:
        out.append("- How it does on clips that it never saw was not measured.")
    if a["help_n"] > 0:
        out.append(f"- Its training still helped by up to {a['help_n']:.0f} N; here nothing helps.")
    kinds = parts.get("recovery", {}).get("kinds", {})
    if not any(k.get("learned") for k in kinds.values()):
        out.append("- It did not learn to get up or to walk back.")
    shapes = config.get("shapes", {}).get("count", 1)
    if shapes > 1:
        out.append(f"- Trained on {shapes} bodies of one skeleton; see the range in the settings.")
    else:
        out.append("- One body; people of other proportions are retargeted onto it.")
    out += [
        "- Flat floor, no objects, no partners; clips with them were left out by rule.",
        "- Simulated in MuJoCo with servos of limited torque; it was never tried on a robot.",
    ]
    return ["## Limits", "", *out]


def _share(x: float) -> str:
    return f"{100 * x:.1f} %"
