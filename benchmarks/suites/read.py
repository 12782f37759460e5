"""Real files, nothing stated: are they read and recognised, how fast; frame rates; motion in place.

The truth of each folder, its unit, vertical and rate, stands in the set's index and in `GROUPS`. Rates
are judged at the right one, at half and at double of it; motion in place beside the same takes with
their travel. The null is a file without motion: every byte of the walk's numbers is zero.
"""

from __future__ import annotations

import csv
import fnmatch
import json
import re
import struct
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.clips import WALK, Places
from benchmarks.common.rows import Figure, of
from benchmarks.common.runner import Part, Raws
from poise.body import generate_table
from poise.errors import PoiseError
from poise.formats import read_clip
from poise.jobs.track import track
from poise.kinematics import by_kind, examine
from poise.kinematics.feet import soles_of
from poise.kinematics.loops import overlap_of, repeated
from poise.kinematics.rate import judge_rate
from poise.kinematics.travel import Travel, find_travel, travelled
from poise.metrics import jerk
from poise.motion import Clip, describe

ASF = 0.0254 / 0.45


#: A unit counts as found within this share of the truth, a frame rate within this one.
UNIT_SLACK, RATE_SLACK = 0.05, 0.001


@dataclass(frozen=True)
class Group:
    """Files of one source. unit (m) and up: the truth, from their documentation or a twin in another
    format; None where the format itself states it. skip: why they are no human motion in 3-D. columns:
    the index counts markers or coordinates, not the joints that they are made into."""

    title: str
    pattern: str
    unit: float | None = None
    up: str | None = None
    skeleton: str | None = None
    skip: str = ""
    columns: bool = False


#: The first pattern that fits decides.
GROUPS = (
    Group("CMU, ASF and AMC, RFC's clips", "cmu_amc/rfc/*.amc", ASF, "Y", "cmu_amc/rfc/08.asf"),
    Group("CMU, ASF and AMC", "cmu_amc/*.amc", ASF, "Y"),
    Group("CMU as BVH, 43 joints", "cmu_bvh/acrnn_*", 0.01, "Y"),
    Group("CMU as BVH, 31 joints", "cmu_bvh/fairmotion/*", ASF, "Y"),
    Group("CMU as BVH, 31 joints", "cmu_bvh/ad/14_14.bvh", ASF, "Y"),
    Group("CMU as BVH, 31 joints", "cmu_bvh/ad/jumping_jacks.bvh", ASF, "Y"),
    # heiansyodan is 135_06: its path has the length of the AMC's if one unit is an inch.
    Group("CMU as BVH, V conversion", "cmu_bvh/ad/*", 0.0254, "Z"),
    Group("DeepMimic", "deepmimic_txt/*", 1.0, "Y"),
    Group("LAFAN1", "lafan1_bvh/*", 0.01, "Y"),
    Group("Bandai Namco", "other/bandai_bvh/*", 0.01, "Y"),
    Group("MASS", "other/mass_bvh/*", 0.01, "Y"),
    Group("Xsens", "other/xsens_bvh/*", 0.01, "Y"),
    Group("Rokoko, from a video", "noisy/rokoko_video/*", 0.01, "Y"),
    Group("Pose2Sim, 3-D keypoints", "noisy/pose2sim/*.trc", 1.0, "Y", columns=True),
    Group("Pose2Sim, 2-D keypoints", "noisy/pose2sim/*_json/", skip="one camera's 2-D picture"),
    Group("Pose2Sim, OpenSim angles", "noisy/pose2sim/*.mot", columns=True),
    Group("AIST++, SMPL", "amass/*.pkl"),
    Group("AMP and ASE, poselib", "other/ase_npy/*.npy"),
    # The index adds up the frames of its thirty motions, of which one is read.
    Group("MDM, generated", "other/text_to_motion/mdm*", 1.0, "Y", columns=True),
    Group("Kimodo", "other/text_to_motion/kimodo*", skip="a robot's joint angles"),
    Group("LocoMuJoCo", "other/loco_mujoco_npz/*", columns=True),
    Group("dm_control", "other/dm_control/*", skip="a simulated model's coordinates"),
    Group(
        "damaged on purpose",
        "other/malformed/*",
        skeleton="cmu_amc/usc/135-martialArts.asf",
        skip="a damaged file",
    ),
)


def group_of(path: str) -> Group:
    """The group of an index path."""
    other = Group("others", "*")
    return next((g for g in GROUPS if fnmatch.fnmatch(path, g.pattern)), other)


def look(data: Path, row: dict[str, str]) -> dict[str, Any]:
    """Reads one file and examines its motion; only the reading is timed."""
    group, file = group_of(row["path"]), data / row["path"]
    size = sum(f.stat().st_size for f in ([file] if file.is_file() else file.glob("*"))) / 1e6
    out: dict[str, Any] = {"group": group.title, "skip": group.skip, "megabytes": size, "refused": ""}
    skeleton = None if group.skeleton is None else data / group.skeleton
    start = time.process_time()
    try:
        clip = read_clip(file, skeleton=skeleton, allow_pickle=True)
    except PoiseError as problem:
        return out | {"refused": problem.what, "seconds": time.process_time() - start}
    out["seconds"] = time.process_time() - start
    facts = describe(clip)
    return out | {
        "format": facts["format"],
        "wrong": list(_wrong(row, group, facts)),
        "faults": {kind: len(f) for kind, f in by_kind(examine(clip).faults).items()},
    }


def _wrong(row: dict[str, str], group: Group, facts: dict[str, Any]) -> list[str]:
    """Guesses that differ from the truth."""
    out = []
    if group.unit is not None and abs(facts["unit_m"] / group.unit - 1) > UNIT_SLACK:
        out.append(f"unit {facts['unit_m']:.4g} m instead of {group.unit:.4g}")
    if group.up is not None and facts["up_axis"] != group.up:
        out.append(f"{facts['up_axis']} up instead of {group.up}")
    if row["fps"] and abs(facts["fps"] / float(row["fps"]) - 1) > RATE_SLACK:
        out.append(f"{facts['fps']:.4g} frames/s instead of {row['fps']}")
    if group.columns:
        return out
    if row["frames"] and facts["frames"] != int(row["frames"]) - _dropped(facts["warnings"]):
        out.append(f"{facts['frames']} frames instead of {row['frames']}")
    if row["joints"] and facts["joints"] != int(row["joints"]):
        out.append(f"{facts['joints']} joints instead of {row['joints']}")
    return out


def _dropped(notes: Sequence[str]) -> int:
    """Frames of a rest pose that reading left out."""
    for note in notes:
        if note.startswith("Frame 0 is a rest pose"):
            more = re.search(r"these (\d+) frames", note)
            return int(more[1]) if more else 1
    return 0


# --- frame rates ----------------------------------------------------------------------------------


#: Clips that state (or are taken to have) 120 frames/s and were captured at 60: flips and handsprings
#: that fall with four times gravity, a cartwheel of the same subject, and salsa that is out of balance
#: in two thirds of the frames. `mass_bvh/backflip` is 88_01, on a larger body.
SIXTY = re.compile(r"90_(02|08|11)\.amc|88_01|acrnn_salsa|mass_bvh/backflip")


#: The first pattern that fits tells the kind of a motion.
KINDS = (
    ("keyed by hand", r"keyed_cc0"),
    (
        "flips, jumps, runs",
        r"01_01|02_0[34]\.amc|05_(06|07|13)|88_01|90_\d\d|13_(29|31)|handspring|jumping_jacks|backflip"
        r"|cartwheel|humanoid3d_(jump|run|spinkick|roll)|_run_|_dash_|mass_bvh/(run|cart)",
    ),
    ("walks", r"walk|02_0[12]\.amc|cmu_amc/(06|07|08|10|35|38|39|43)/|91_\d\d|constspeed"),
    ("others", r""),
)


CHOSEN = re.compile(r"cmu_amc/|cmu_bvh/acrnn|deepmimic_txt|88_01")


#: Of the shipped tracker's library: what is in FOLDER, and at which rates it was learned.
LIBRARY = re.compile(
    r"cmu_amc/(01|02|06|07|10|35|rfc)/(?!05)|cmu_bvh/(ad/(?!14_14)|acrnn_(indian|martial)"
    r"|acrnn_salsa/(?!11|13|14|26|28|29))|deepmimic_txt/(?!sie)"
)


LEARNED = ((r"90_(02|08|11)\.amc", 60.0), (r"salsa", 60.0))


TIMES = {"right": 1.0, "double": 2.0, "half": 0.5}


def judged(name: str, clip: Clip) -> dict[str, Any]:
    """A clip's judgements at its right rate, at double and half, and as it was learned."""
    row: dict[str, Any] = {"clip": name, "frames": clip.frames, "fps": clip.fps}
    try:
        table = generate_table(clip.skeleton, None, [clip])
    except PoiseError:
        return {**row, "human": False}
    truth = clip.fps / 2 if SIXTY.search(name) else clip.fps
    row |= {"human": True, "truth": truth}
    rates = {word: truth * times for word, times in TIMES.items()} | {"stated": clip.fps}
    if LIBRARY.search(name):
        rates["learned"] = next((r for p, r in LEARNED if re.search(p, name)), clip.fps)
    for word, fps in rates.items():
        start = time.process_time()
        found = judge_rate(clip.replaced(fps=fps), table)
        row[word] = {
            "likely": found.likely,
            "kinds": sorted({r.kind for r in found.reasons}),
            "why": found.why(),
            "vouched": found.vouched,
            "ms": 1e3 * (time.process_time() - start),
        }
    return row


def kind_of(name: str) -> str:
    return next(kind for kind, pattern in KINDS if re.search(pattern, name))


def rate_figures(rows: list[dict[str, Any]]) -> list[tuple[str, str, float | str, int]]:
    """Subject, metric, value and n of everything that was measured."""
    out: list[tuple[str, str, float | str, int]] = []
    human = [r for r in rows if r["human"]]
    captured = [r for r in human if kind_of(r["clip"]) != "keyed by hand"]
    for kind, _ in KINDS:
        mine = [r for r in human if kind_of(r["clip"]) == kind]
        halves = {"": mine}
        if kind != "keyed by hand":
            halves |= {
                ", chosen on": [r for r in mine if CHOSEN.search(r["clip"])],
                ", only measured": [r for r in mine if not CHOSEN.search(r["clip"])],
            }
        for half, part in halves.items():
            out += _shares(kind + half, part)
    out += _shares("all but keyed", captured)
    for r in human:
        if r["right"]["likely"] is not None:
            out.append((r["clip"], "named at its right rate, Hz", r["right"]["likely"], 1))
    for r in human:
        if r["stated"]["likely"] is not None:
            out.append((r["clip"], "likely, Hz, at the rate that it states", r["stated"]["likely"], 1))
    learned = [r for r in human if LIBRARY.search(r["clip"])]
    wrong = [r for r in learned if r["learned"]["likely"] is not None]
    out.append(("tracker's library", "clips judged", len(learned), len(learned)))
    out.append(
        (
            "tracker's library",
            "vouched by flights",
            sum(r["learned"]["vouched"] for r in learned),
            len(learned),
        )
    )
    out.append(("tracker's library", "learned at a wrong rate", len(wrong), len(learned)))
    out += [
        (f"tracker's library: {r['clip']}", "likely rate, Hz", r["learned"]["likely"], 1) for r in wrong
    ]
    ms = [r["right"]["ms"] for r in human if r["frames"] / r["fps"] <= 10.0]
    out.append(("clips of up to 10 s", "ms of a core, median", round(float(np.median(ms)), 1), len(ms)))
    out.append(
        (
            "clips of up to 10 s",
            "ms of a core, 95th percentile",
            round(float(np.quantile(ms, 0.95)), 1),
            len(ms),
        )
    )
    return out


def _shares(subject: str, rows: list[dict[str, Any]]) -> list[tuple[str, str, float | str, int]]:
    out: list[tuple[str, str, float | str, int]] = []
    n = len(rows)
    if not n:
        return out
    for word in TIMES:
        named = [r for r in rows if r[word]["likely"] is not None]
        out.append((subject, f"named at {word} rate", round(len(named) / n, 4), n))
        for kind in ("fall", "balance", "gait"):
            by = sum(kind in r[word]["kinds"] for r in named)
            out.append((subject, f"named at {word} rate by {kind}", round(by / n, 4), n))
        if word != "right":
            right = sum(abs(r[word]["likely"] / r["truth"] - 1) < 0.02 for r in named)
            out.append((subject, f"right rate told at {word} rate", round(right / n, 4), n))
    return out


# --- motion in place ------------------------------------------------------------------------------


#: Takes that travel, and words of those that do not.
TRAVELS = re.compile(r"walk|run|jog|sprint|sneak|crawl|crouch_fwd|crouching|push_loop", re.I)


#: The version of a take that keeps its travel.
MOVES = re.compile(r"[ _]?(RM|root ?motion)$", re.I)


#: Straight walks and runs among real clips, by name.
STRAIGHT = re.compile(r"(walk(?!-turn)|run(?!_left)|dash)|cmu_amc/(02/02_0[123]|06|07|08|35)/?", re.I)


LOW_M, FLAT_M = 0.04, 0.03


def takes_of(path: Path) -> list[str]:
    """The names of a GLB file's animations."""
    data = path.read_bytes()
    size = struct.unpack("<I", data[12:16])[0]
    return [a.get("name", "") for a in json.loads(data[20 : 20 + size]).get("animations", ())]


def loops_of(data: Path) -> list[tuple[Path, str, bool]]:
    """Every take of the keyed files: its file, its name, and whether the name says that it travels."""
    out = []
    for path in sorted((data / "other/keyed_cc0").glob("*.glb")):
        for take in takes_of(path):
            moves = bool(TRAVELS.search(take.rpartition("|")[2]))
            out.append((path, take, moves))
    return out


def true_speeds(clip: Clip) -> tuple[float, float]:
    """m/s at which soles go over the floor: of the lowest end (of a walk, which always stands on a foot,
    the mean, of a run the median), and the median of soles with both ends low."""
    table = generate_table(clip.skeleton, None, [clip])
    pos, quat = (x[:, [r.joint for r in table.rows]] for x in clip.world())
    soles = np.stack([s.ends for s in soles_of(table, pos, quat).values()], 1)
    z, step = 0.5 * (soles[1:, ..., 2] + soles[:-1, ..., 2]), np.diff(soles, axis=0)[..., :2] * clip.fps
    ends, at = z.reshape(len(z), -1), np.arange(len(z))
    low = ends.argmin(1)
    height, velocity = ends[at, low], step.reshape(len(z), -1, 2)[at, low]
    down = height <= np.quantile(height, 0.05) + LOW_M
    middle = np.mean if down.mean() > 0.7 else np.median
    flat = z.max(-1) <= np.quantile(z.max(-1), 0.05, axis=0) + FLAT_M
    pair = (middle(velocity[down], axis=0), np.median(step.mean(2)[flat], axis=0))
    return float(np.linalg.norm(pair[0])), float(np.linalg.norm(pair[1]))


def told_rows(data: Path) -> list[tuple[str, str, float]]:
    """Speeds that were told beside the truth, and takes that stand but were taken for a walk."""
    out, read = list[tuple[str, str, float]](), dict[tuple[Path, str], Clip]()
    for path, take, _ in loops_of(data):
        try:
            read[path, take] = read_clip(path, take=take)
        except PoiseError:
            continue
    wrong, near = 0, list[bool]()
    for path, take, moves in loops_of(data):
        clip, name = read.get((path, take)), take.rpartition("|")[2]
        if clip is None or MOVES.search(take):
            continue
        travel = find_travel(clip)
        if not moves:
            wrong += travel is not None
            continue
        pair = next(
            (c for (p, t), c in read.items() if p == path and MOVES.sub("", t) == take != t), None
        )
        if pair is None:
            truths = true_speeds(clip)
        else:
            way = (pair.root_pos[-1] - pair.root_pos[0])[:2] - (clip.root_pos[-1] - clip.root_pos[0])[:2]
            truths = (float(np.linalg.norm(way)) / clip.seconds,) * 2
        told = travel.speed if travel else 0.0
        out += [(name, "lowest_m_per_s", truths[0]), (name, "flat_m_per_s", truths[1])]
        out += [(name, "told_m_per_s", told)]
        near.append(min(abs(told / t - 1) for t in truths) <= 0.1)
    travel = "takes that travel"
    out += [(travel, "clips", len(near)), (travel, "within_10_percent", sum(near))]
    out.append(("takes that stand", "taken_for_a_walk", wrong))
    return out


def real_rows(data: Path) -> list[tuple[str, str, float]]:
    """Real clips as they are, and straight ones without their mean velocity."""
    rows = list(csv.DictReader((data / "INDEX.tsv").open(), delimiter="\t"))
    seen, alarms, ratios = 0, 0, list[tuple[str, float]]()
    for row in rows:
        path = row["path"]
        if path.endswith((".asf", ".glb")):
            continue
        skeleton = data / "cmu_amc/rfc/01.asf" if "rfc/" in path else None
        try:
            clip = read_clip(data / path, skeleton=skeleton, allow_pickle=True)
            table = generate_table(clip.skeleton, None, [clip])
        except (PoiseError, OSError):
            continue
        seen += 1
        alarms += find_travel(clip, table) is not None
        root = clip.positions()[:, table.rows[0].joint]
        v = (root[-1] - root[0]) / clip.seconds * np.array([1.0, 1.0, 0.0])
        left = root - np.arange(clip.frames)[:, None] / clip.fps * v
        steady = bool((np.ptp(left[:, :2], axis=0) < 0.6).all())
        if STRAIGHT.search(path) and np.linalg.norm(v) > 0.3 and steady:
            shift = np.arange(clip.frames)[:, None] / clip.fps * v
            travel = find_travel(clip.replaced(root_pos=clip.root_pos - shift), table)
            ratios.append((path, travel.speed / float(np.linalg.norm(v)) if travel else 0.0))
    out = [("real clips as they are", "clips", seen), ("real clips as they are", "in_place", alarms)]
    found = np.array([r for _, r in ratios])
    name = "straight walks and runs without their mean velocity"
    out += [(name, "clips", len(found)), (name, "told", float((found > 0).sum()))]
    out += [(name, "within_10_percent", float((np.abs(found - 1) <= 0.1).sum()))]
    out += [(name, "told_over_true", float(np.median(found[found > 0])))]
    return out


def loop_figures(clip: Clip, overlap: int, travel: Travel) -> dict[str, float]:
    """Slide (mm/s) and jerk (m/s^3) of a loop that is repeated with a travel, and the jerk of its seams
    over the largest elsewhere."""
    long, period = travelled(repeated(clip, overlap, 4), travel), clip.frames - overlap
    shake = jerk(long.positions(), clip.fps)
    seam = np.zeros(len(shake), dtype=bool)
    # A third difference of frames i to i + 3 reaches across the seam at k P.
    for k in range(1, 4):
        seam[max(0, k * period - 3) : k * period + 1] = True
    return {
        "slide_mm_per_s": examine(long).figures["sole_slide_mm_per_s"] or 0.0,
        "jerk_m_per_s3": float(shake.mean()),
        "seam_over_own_jerk": float(shake[seam].max() / shake[~seam].max()),
    }


def track_rows(data: Path, only: str) -> list[tuple[str, str, float]]:
    """A loop as it is written, beside its source."""
    out = list[tuple[str, str, float]]()
    for path, take, moves in loops_of(data):
        name = take.rpartition("|")[2]
        if not moves or name != only or MOVES.search(take):
            continue
        clip = read_clip(path, take=take)
        overlap = overlap_of(clip)
        travel = None if overlap is None else find_travel(repeated(clip, overlap, 1))
        if overlap is None or travel is None:
            continue
        for how in ("source", "auto", "keep"):
            made, lost = clip, 0
            if how != "source":
                done = track(clip, in_place=how)
                made, lost = done.clip, len(done.failures)
            found = loop_figures(made, overlap, travel) | (
                {} if how == "source" else {"lost": float(lost)}
            )
            out += [(f"{name}, {how}", metric, value) for metric, value in found.items()]
    return out


# --- parts ----------------------------------------------------------------------------------------


@cache
def index(places: Places) -> dict[str, dict[str, str]]:
    """The files of the set; skeletons alone are no motion, they are read with motions that need them."""
    if places.smoke:
        return {"walk.bvh": dict.fromkeys(("fps", "frames", "joints"), "") | {"path": str(WALK)}}
    with (places.data / "INDEX.tsv").open(newline="") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    return {r["path"]: r for r in rows if not r["path"].endswith(".asf")}


def read_one(places: Places, unit: str) -> Any:
    """A file of the index; the first one that a process reads pays for imports that are no reading."""
    read_clip(WALK)
    if unit == NULL:
        return empty(places)
    return look(places.data, index(places)[unit])


NULL = "a file without motion"


def empty(places: Places) -> dict[str, Any]:
    """The walk, every frame's numbers zero: what is read of it, and what the doctor says."""
    text = WALK.read_text()
    head, _, rows = text.partition("Frame Time:")
    first, *frames = rows.strip().splitlines()
    zero = "\n".join(" ".join("0" for _ in line.split()) for line in frames)
    file = places.work / "empty.bvh"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"{head}Frame Time: {first}\n{zero}\n")
    row = {"path": str(file), "fps": "", "frames": "", "joints": ""}
    return look(places.data, row)


def read_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Shares, and seconds a megabyte, together and by format."""
    seen = [r for u, r in raws.items() if u != NULL]
    human, read = [r for r in seen if not r["skip"]], [r for r in seen if not r["refused"]]
    size, spent = (sum(r[k] for r in read) for k in ("megabytes", "seconds"))
    values = {
        "read": sum(not r["refused"] for r in human) / len(human),
        "recognised_otherwise": sum(bool(r["wrong"]) for r in read),
        "s_per_mb": spent / size,
        "megabytes": size,
        "without_a_fault": sum(not r["faults"] for r in read) / len(read),
    }
    yield from of("real motion files, nothing stated", values, len(human))
    for name in dict.fromkeys(r["format"] for r in read):
        own = [r for r in read if r["format"] == name]
        rate = sum(r["seconds"] for r in own) / sum(r["megabytes"] for r in own)
        yield from of(name, {"files": len(own), "s_per_mb": rate}, len(own))
    null = raws[NULL]
    yield from of(
        NULL, {"read": float(not null["refused"]), "faults": sum(null.get("faults", {}).values())}, 1
    )


def rate_files(places: Places) -> list[str]:
    """Every motion of the folder by its path there, takes apart."""
    if places.smoke:
        return ["walk.bvh"]
    out = []
    for path in sorted(p for p in places.data.rglob("*") if p.is_file()):
        name = path.relative_to(places.data).as_posix()
        if "malformed" in name or path.suffix in (".json", ".tsv", ".asf", ".csv", ".h5", ""):
            continue
        out += [name if take is None else f"{name}#{take}" for take in _takes(path)]
    return out


def _takes(path: Path) -> list[str | None]:
    """The names of a GLB's animations; the numbers of a file of MDM's results."""
    if path.suffix == ".glb":
        return list(takes_of(path))
    return [str(k) for k in range(30)] if "mdm_results" in path.name else [None]


def rate_of(places: Places, unit: str) -> Any:
    """A motion's judgements; None where it cannot be read."""
    name, _, take = unit.partition("#")
    path = places.file(name)
    skeleton = None
    if path.suffix == ".amc":
        skeleton = places.data / "cmu_amc/rfc/08.asf" if "/rfc/" in name else None
        skeleton = places.data / "cmu_amc/01/01.asf" if "cmu_hard" in name else skeleton
    try:
        clip = read_clip(path, skeleton=skeleton, take=take or None, allow_pickle=True)
    except PoiseError:
        return None
    return judged(unit, clip)


def rate_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Shares by kind of motion and of evidence, and every name that was named."""
    for subject, metric, value, n in rate_figures([r for r in raws.values() if r is not None]):
        yield Figure(subject, metric, float(value), n)


def told(places: Places, unit: str) -> Any:
    """Keyed loops: the speed that is told beside the truth; takes that stand."""
    return [] if places.smoke else told_rows(places.data)


def real(places: Places, unit: str) -> Any:
    """Real clips as they are and without their mean velocity."""
    return [] if places.smoke else real_rows(places.data)


def as_told(places: Places, raws: Raws) -> Iterator[Figure]:
    """As they were measured."""
    for raw in raws.values():
        for subject, metric, value in raw:
            yield Figure(subject, metric, value, 1)


def loop_units(places: Places) -> list[str]:
    """Loops that travel, by their names."""
    if places.smoke:
        return ["walk"]
    found = loops_of(places.data)
    return sorted({t.rpartition("|")[2] for _, t, moves in found if moves and not MOVES.search(t)})


def looped(places: Places, unit: str) -> Any:
    """A loop as it is written, beside its source."""
    if places.smoke:
        clip = read_clip(WALK)
        return [
            [
                "walk, source",
                "jerk_m_per_s3",
                float(jerk(clip.positions(), clip.fps).mean()),
            ]
        ]
    return track_rows(places.data, unit)


PARTS = {
    "files": Part("every file of the set", lambda p: [*index(p), NULL], read_one, read_rows, hours=0.15),
    "rates": Part("frame rates judged by physics", rate_files, rate_of, rate_rows, hours=0.1),
    "in place, told": Part("speeds of keyed loops", lambda _: ["told"], told, as_told, hours=0.02),
    "in place, real": Part("real clips, which travel", lambda _: ["real"], real, as_told, hours=0.05),
    "in place, tracked": Part(
        "keyed loops as they are written", loop_units, looped, as_told, ("tracker",), hours=0.5
    ),
}
