"""Motions tracked by the policy alone and without help, as the field reports it.

Every clip from its first frame to its end, exactly and from starts that are drawn (`common.starts`);
success under three rules (`common.success`), errors until PHC's rule breaks. "nothing" is the null:
action 0, which aims at the motion's own joint angles.
"""

from __future__ import annotations

import resource
from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any, Literal

import numpy as np

from benchmarks.common.clips import SETS, SINGLE, Places, clip_of, library, moment, names_of, single
from benchmarks.common.field import TRIALS, chunks, episodes, figures, measured
from benchmarks.common.rows import Figure, mean_of, of
from benchmarks.common.runner import Part, Raws
from poise.body import generate_table
from poise.env.pushes import Pushes
from poise.errors import PoiseError
from poise.formats.raw import ReadOptions
from poise.jobs.open import open_run
from poise.jobs.track import TrackConfig, imitation_of, track
from poise.jobs.track.placement import place, points_of
from poise.jobs.track.robustness import robustness
from poise.jobs.tracker import Tracker
from poise.motion import Clip, shifted
from poise.motion.mirror import mirrored_clip
from poise.motion.noise import robustness_levels

#: Clips that are simulated side by side.
AT_ONCE = 16
EXACT = TRIALS[:1]
#: m, of people; a second is that of a walk's.
HEIGHTS_M = (1.16, 1.33, 1.5, 1.67, 1.83, 2.0)
#: Of a blow every two seconds.
PUSH_N, PUSH_S = 150.0, 0.1
STRENGTHS = (0.0, 0.25, 0.5, 1.0, 2.0)
METHODS = {
    "policy alone": ("tracker", True),
    "policy of keypoints alone": ("keypoints", True),
    "nothing (action 0)": ("tracker", False),
}


@cache
def policy_of(kind: str) -> Tracker:
    """A policy that ships."""
    return open_run(None if kind == "tracker" else kind).tracker


# --- sets of clips --------------------------------------------------------------------------------


def units(places: Places, name: str) -> list[str]:
    """Groups of a set's clips."""
    return list(chunks(names_of(places, name), AT_ONCE))


def episodes_of(places: Places, unit: str, of_set: str, method: str, trials: tuple[int, ...]) -> Any:
    """One group by one method; clips that no body can be set on are told."""
    kind, acts = METHODS[method]
    tracker, usable, refused = policy_of(kind), [], {}
    for clip in chunks(names_of(places, of_set), AT_ONCE)[unit]:
        try:
            usable.append(place(clip_of(places, of_set, clip), tracker))
        except PoiseError as problem:
            refused[clip] = problem.what
    if not usable:
        return {"episodes": [], "refused": refused}
    task = imitation_of(tracker, usable)
    found = measured(task, tracker.policy if acts else None, trials)
    return {"episodes": found, "refused": refused}


def set_rows(
    places: Places, raws: Raws, name: str, method: str, listed: bool = False
) -> Iterator[Figure]:
    """Figures of a set; listed: and whether each of its clips is done."""
    subject = f"{SETS[name].title}; {method}"
    rows = [e for raw in raws.values() for e in raw["episodes"]]
    yield from figures(subject, rows)
    refused = sum(len(raw["refused"]) for raw in raws.values())
    yield Figure(subject, "refused", refused, len(rows) + refused)
    if listed:
        for e in (e for e in rows if not e["trial"]):
            yield Figure(f"{e['clip']}; {method}", "done", float(e["won"]["phc"]), 1)


def set_part(
    name: str, method: str, trials: tuple[int, ...], hours: float, listed: bool = False
) -> Part:
    """The part of one set and method."""
    needs = ("data",) if SETS[name].pattern else ("library",)
    return Part(
        f"{SETS[name].title}, {SETS[name].learned}",
        partial(units, name=name),
        partial(episodes_of, of_set=name, method=method, trials=trials),
        partial(set_rows, name=name, method=method, listed=listed),
        (METHODS[method][0],),
        hours=hours,
        needs=needs,
    )


# --- files of pose estimators ---------------------------------------------------------------------


def estimated(places: Places, unit: str) -> Any:
    """An estimator's own file as it is: the field's errors against what came in."""
    try:
        clip = clip_of(places, "estimators", unit)
        given = points_of(clip, ReadOptions()) or clip
        done = track(given, policy_of("tracker"), TrackConfig(controller="policy"))
    except PoiseError as problem:
        return {"episodes": [], "refused": {unit: problem.what}}
    return {"episodes": episodes(done.evaluation.rollouts), "refused": {}}


# --- noise, sizes, an hour ------------------------------------------------------------------------


def noisy(places: Places, unit: str, controller: Literal["policy", "lookahead"] = "policy") -> Any:
    """A clip's success at each strength of a video estimator's errors."""
    strengths = STRENGTHS[:2] if places.smoke else STRENGTHS
    levels = robustness_levels(strengths=strengths)
    clips = [clip_of(places, "bandai", unit)]
    return robustness(policy_of("tracker"), clips, levels, controller=controller).to_dict()["rungs"]


def noisy_rows(places: Places, raws: Raws, words: str = "policy alone") -> Iterator[Figure]:
    """Shares by strength: done to the end of what came in, and within half a metre of the motion without
    errors."""
    names = {"succ": "done", "succ_clean": "near_truth", "tracked": "tracked"}
    for k, rung in enumerate(next(iter(raws.values()))):
        rows = [raw[k] for raw in raws.values()]
        subject = f"{SETS['bandai'].title}, noise {rung['name']}; {words}"
        numbers = {told: mean_of(r[m] for r in rows) for m, told in names.items() if m in rung}
        yield from of(subject, numbers, len(rows))


def pushed(places: Places, unit: str) -> Any:
    """One group of clips, pushed at the chest in four drawn horizontal directions each time anew."""
    tracker = policy_of("tracker")
    clips = chunks(names_of(places, "bandai")[::2], AT_ONCE)[unit]
    task = imitation_of(tracker, [place(clip_of(places, "bandai", c), tracker) for c in clips])
    chest, hz = task.humanoid.rows_of("spine")[-1], tracker.config.sim.control_hz
    out = []
    for seed in TRIALS:
        blows = Pushes((PUSH_N, PUSH_N), (2.0 - PUSH_S, 2.0 - PUSH_S), PUSH_S, (chest,), hz, seed)
        own = replace(task, task=replace(task.task, events=(*task.task.events, blows)))
        out += measured(own, tracker.policy, EXACT)
    return {"episodes": out}


def pushed_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Success and errors of all episodes."""
    rows = [e for raw in raws.values() for e in raw["episodes"]]
    subject = (
        f"{SETS['bandai'].title}, every other clip, four times, {PUSH_N:g} N for {PUSH_S:g} s every 2 s"
    )
    yield from figures(f"{subject}; policy alone", rows)


def sized(clip: Clip, height_m: float) -> Clip:
    """A clip of a person as tall as that, who does the same in the same time."""
    factor = height_m / generate_table(clip.skeleton, None, [clip]).height_m
    skeleton = clip.skeleton
    ends = tuple((j, (x * factor, y * factor, z * factor)) for j, (x, y, z) in skeleton.ends)
    bones = skeleton.__class__(skeleton.names, skeleton.parents, skeleton.offsets * factor, ends)
    return clip.replaced(skeleton=bones, root_pos=clip.root_pos * factor)


def bodies(places: Places, unit: str) -> Any:
    """A clip scaled to people of six sizes, on the policy's body and on one with the clip's bones."""
    out = {}
    for height in HEIGHTS_M[:1] if places.smoke else HEIGHTS_M:
        for body in ("policy", "own"):
            config = TrackConfig(body=body, controller="policy", threads=1)  # type: ignore[arg-type]
            try:
                card = track(sized(single(places, unit), height), policy_of("tracker"), config).card
            except PoiseError:
                out[f"{height:g} m, {body} body"] = [0.0, None]
                continue
            out[f"{height:g} m, {body} body"] = [float(card.tracked == 1.0), card.mpjpe_global_mm]
    return out


def body_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Shares and errors by size."""
    for name in next(iter(raws.values())):
        rows = [raw[name] for raw in raws.values()]
        values = {"done": mean_of(r[0] for r in rows), "g_mpjpe_mm": mean_of(r[1] for r in rows)}
        yield from of(f"sixteen clips, {name}; policy alone", values, len(rows))


def in_a_row(places: Places, minutes: float, seed: int = 0) -> list[Clip]:
    """Clips of the library of so many minutes in an order that is drawn, then their mirror images, each
    beginning at the origin."""
    if places.smoke:
        clips = [moment("a"), moment("b")]
    else:
        found = list(library(places, "library").values())
        clips = [found[k] for k in np.random.default_rng(seed).permutation(len(found))]
        clips += [mirrored_clip(c).replaced(name=f"{c.name}-mirrored") for c in clips]
    total, out = 0.0, list[Clip]()
    for clip in clips:
        if total >= 60 * minutes:
            break
        out.append(shifted(clip, (-clip.root_pos[0, 0], -clip.root_pos[0, 1], 0.0)))
        total += clip.seconds
    return out


def hour(places: Places, unit: str) -> Any:
    """Clips one after another by one character; a recovery motion leads from the end of each to the
    start of the next, and back to a clip that was lost. A clip that is lost nine times is given up; a
    character that does not come to three clips in a row has fallen for good."""
    clips = in_a_row(places, 60.0)
    how = TrackConfig(recover=True, controller="policy", supports="none")
    tracked = track(clips, policy_of("tracker"), how)
    losses, parts = tracked.losses, tracked.parts
    lost, back = (losses.lost, losses.back) if losses else ((), ())
    away = np.subtract(back, lost[: len(back)])
    return {
        "clips": len(clips),
        "clips_done": sum(p.done for p in parts),
        "clips_without_a_loss": sum(p.done and p.lost is None for p in parts),
        "losses": len(lost),
        "came_back": len(back),
        "away_s": float(away.mean()) if len(away) else None,
        "away_most_s": float(away.max()) if len(away) else None,
        "falls_for_good": int(not parts[-1].done and parts[-1].begins is None),
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }


def hour_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Its counts."""
    found = raws["hour"]
    subject = "an hour of clips in a row, with recovery; policy alone"
    yield from of(subject, found, found["clips"])


PARTS = {
    "bandai, policy": set_part("bandai", "policy alone", TRIALS, 0.3),
    "bandai, keypoints": set_part("bandai", "policy of keypoints alone", TRIALS, 0.3),
    "bandai, nothing": set_part("bandai", "nothing (action 0)", TRIALS, 0.3),
    "bandai-test, policy": set_part("bandai-test", "policy alone", TRIALS, 0.15),
    "bandai-test, keypoints": set_part("bandai-test", "policy of keypoints alone", TRIALS, 0.15),
    "held-out, policy": set_part("held-out", "policy alone", TRIALS, 0.05),
    "held-out, keypoints": set_part("held-out", "policy of keypoints alone", TRIALS, 0.05),
    "library, policy": set_part("library", "policy alone", EXACT, 0.3),
    "library, keypoints": set_part("library", "policy of keypoints alone", EXACT, 0.3),
    "library, nothing": set_part("library", "nothing (action 0)", EXACT, 0.3),
    "copies, policy": set_part("copies", "policy alone", EXACT, 0.4),
    "copies, keypoints": set_part("copies", "policy of keypoints alone", EXACT, 0.4),
    "acrobatics, policy": set_part("acrobatics", "policy alone", EXACT, 0.05, listed=True),
    "subject 49, policy": set_part("subject 49", "policy alone", EXACT, 0.05),
    "estimators": Part(
        "files of real pose estimators",
        lambda p: names_of(p, "estimators"),
        estimated,
        partial(set_rows, name="estimators", method="policy alone"),
        ("tracker",),
        hours=0.05,
    ),
    "noise": Part(
        "strengths of a video estimator's errors",
        lambda p: names_of(p, "bandai")[::7],
        noisy,
        noisy_rows,
        ("tracker",),
        hours=0.1,
    ),
    "noise, lookahead": Part(
        "the same with lookahead",
        lambda p: names_of(p, "bandai")[::7],
        partial(noisy, controller="lookahead"),
        partial(noisy_rows, words="with lookahead"),
        ("tracker",),
        hours=0.3,
    ),
    "pushes": Part(
        "blows to the chest",
        lambda p: list(chunks(names_of(p, "bandai")[::2], AT_ONCE)),
        pushed,
        pushed_rows,
        ("tracker",),
        hours=0.1,
    ),
    "bodies": Part(
        "people of six sizes",
        lambda p: ["02_01"] if p.smoke else [n for n in SINGLE if n != "backflip"],
        bodies,
        body_rows,
        ("tracker",),
        hours=0.3,
    ),
    "hour": Part(
        "an hour by one character",
        lambda _: ["hour"],
        hour,
        hour_rows,
        ("tracker",),
        hours=0.5,
        needs=("library",),
    ),
}
