"""Motion in place: is its travel told, is nothing else taken for it, and what a body makes of its loops.

    python benchmarks/in_place.py --data FOLDER --parts told real track -o results/in_place.csv

FOLDER holds the development set, as `INDEX.tsv` lists it. Three parts:

told: all loops of `other/keyed_cc0` whose takes' names say that they travel. The truth is the same take
with its travel where the file has it, else what soles do near the floor by plain differences, without
weights or a fit, in two ways (`true_speeds`): feet keyed by hand have no one speed while they bear.
real: all clips that travel or stand, as they are (none is in place), and those that walk or run straight
with their mean velocity subtracted (all are, at that speed).
track: loops as `poise track` writes them beside their sources, and with `--in-place keep`, all repeated
with the travel of the source: slide of soles, jerk, and the jerk at the seam over the largest elsewhere.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import struct
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import torch

from poise.body import generate_table
from poise.errors import PoiseError
from poise.formats import read_clip
from poise.jobs.track import track
from poise.kinematics import examine
from poise.kinematics.feet import soles_of
from poise.kinematics.loops import overlap_of, repeated
from poise.kinematics.travel import Travel, find_travel, travelled
from poise.metrics import jerk
from poise.motion import Clip

COLUMNS = ("subject", "metric", "value", "spread", "n", "seeds", "policy", "commit", "command")
#: Takes that travel, and words of those that do not.
TRAVELS = re.compile(r"walk|run|jog|sprint|sneak|crawl|crouch_fwd|crouching|push_loop", re.I)
#: The version of a take that keeps its travel.
MOVES = re.compile(r"[ _]?(RM|root ?motion)$", re.I)
#: Straight walks and runs among real clips, by name.
STRAIGHT = re.compile(r"(walk(?!-turn)|run(?!_left)|dash)|cmu_amc/(02/02_0[123]|06|07|08|35)/?", re.I)
LOW_M, FLAT_M = 0.04, 0.03
#: Loops of the first look: each rig, walks, runs, a sneak, sideways, a crouch.
SAMPLE = (
    "Walk_Loop", "Walk_Formal_Loop", "Jog_Fwd_Loop", "Crouch_Fwd_Loop", "Push_Loop", "Walking_A",
    "Running_A", "Sneaking",
)  # fmt: skip


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
    pos, quat = (torch.tensor(x[:, [r.joint for r in table.rows]]) for x in clip.world())
    soles = torch.stack([s.ends for s in soles_of(table, pos, quat).values()], 1).numpy()
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
    for path, ratio in ratios:
        if abs(ratio - 1) > 0.1:
            print(f"{path}: {ratio:.2f}", flush=True)
    return out


def figures(clip: Clip, overlap: int, travel: Travel) -> dict[str, float]:
    """Slide (mm/s) and jerk (m/s^3) of a loop that is repeated with a travel, and the jerk of its seams
    over the largest elsewhere."""
    long, period = travelled(repeated(clip, overlap, 4), travel), clip.frames - overlap
    shake = jerk(torch.tensor(long.positions()), clip.fps).numpy()
    seam = np.zeros(len(shake), dtype=bool)
    # A third difference of frames i to i + 3 reaches across the seam at k P.
    for k in range(1, 4):
        seam[max(0, k * period - 3) : k * period + 1] = True
    return {
        "slide_mm_per_s": examine(long).figures["sole_slide_mm_per_s"] or 0.0,
        "jerk_m_per_s3": float(shake.mean()),
        "seam_over_own_jerk": float(shake[seam].max() / shake[~seam].max()),
    }


def track_rows(data: Path, names: tuple[str, ...], keep: Path | None) -> list[tuple[str, str, float]]:
    """Loops of those names as they are written, beside their sources."""
    out = list[tuple[str, str, float]]()
    for path, take, moves in loops_of(data):
        name = take.rpartition("|")[2]
        if not moves or (names and name not in names) or MOVES.search(take):
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
                if keep is not None:
                    done.save(keep / f"{name} {how}", force=True)
            found = figures(made, overlap, travel) | ({} if how == "source" else {"lost": float(lost)})
            out += [(f"{name}, {how}", metric, value) for metric, value in found.items()]
            print(name, how, {k: round(v, 2) for k, v in found.items()}, flush=True)
    return out


def main() -> None:
    """Measures the parts that were asked for and adds their rows to the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument(
        "--parts", nargs="+", choices=("told", "real", "track"), default=("told", "real")
    )
    parser.add_argument("--takes", nargs="*", default=SAMPLE, help="loops that are tracked; none is all")
    parser.add_argument("--keep", type=Path, help="a folder for the tracked motions")
    parser.add_argument("-o", type=Path, required=True)
    o = parser.parse_args()
    rows = list[tuple[str, str, float]]()
    rows += told_rows(o.data) if "told" in o.parts else []
    rows += real_rows(o.data) if "real" in o.parts else []
    rows += track_rows(o.data, tuple(o.takes), o.keep) if "track" in o.parts else []
    write(o.o, rows, o.parts)


def write(path: Path, rows: list[tuple[str, str, float]], parts: list[str]) -> None:
    """The rows in place of those of the same subject and metric."""
    commit = subprocess.run(
        ("git", "rev-parse", "--short", "HEAD"), capture_output=True, text=True, check=True
    ).stdout.strip()
    old = list(csv.DictReader(path.open())) if path.exists() else []
    new = {(s, m) for s, m, _ in rows}
    kept = [r for r in old if (r["subject"], r["metric"]) not in new]
    command = f"python benchmarks/in_place.py --data FOLDER --parts {' '.join(parts)} -o {path}"
    made = [(s, m, f"{v:.4g}", "", "1", "0", "", commit, command) for s, m, v in rows]
    path.parent.mkdir(exist_ok=True)
    with tempfile.NamedTemporaryFile("w", dir=path.parent, delete=False, newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([COLUMNS, *([r[c] for c in COLUMNS] for r in kept), *made])
    Path(file.name).replace(path)


if __name__ == "__main__":
    main()
