"""Frame rates judged by physics: every clip at its right rate, at half and at double of it.

    python benchmarks/rates.py --data FOLDER [--also 88_01.amc=08.asf] [--raw RAW.jsonl]

FOLDER holds the sets for development with their `INDEX.tsv`, part of the library of `tracker/README.md`
among them; `--also` adds an AMC file with its skeleton. A clip is judged as a file that states its rate,
so that nothing is taken; named is one with clear evidence for another rate. With `--raw` what is judged
already is read from there, so that an interrupted run goes on. The constants of
`poise.kinematics.rate` were chosen on the sources in `CHOSEN`; the others were only measured. The last
rows judge the part of the shipped tracker's library that is in FOLDER at the rates at which it was
learned.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import struct
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from poise.body import generate_table
from poise.errors import PoiseError
from poise.formats import read_clip
from poise.kinematics.rate import judge_rate
from poise.motion import Clip

COMMAND = "python benchmarks/rates.py --data FOLDER --also 88_01.amc=08.asf"
COLUMNS = ("subject", "metric", "value", "spread", "n", "seeds", "policy", "commit", "command")
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


def takes_of(path: Path) -> list[str | None]:
    """The names of a GLB's animations; the numbers of a file of MDM's results."""
    if path.suffix == ".glb":
        data = path.read_bytes()
        (count,) = struct.unpack("<I", data[12:16])
        found = json.loads(data[20 : 20 + count]).get("animations", [])
        return [a.get("name", str(i)) for i, a in enumerate(found)]
    return [str(k) for k in range(30)] if "mdm_results" in path.name else [None]


def clips(data: Path, also: list[tuple[Path, Path]], done: set[str]) -> Iterator[tuple[str, Clip]]:
    """Every motion of a folder that is not done, by its path there."""
    for path in sorted(p for p in data.rglob("*") if p.is_file()):
        name = path.relative_to(data).as_posix()
        if "malformed" in name or path.suffix in (".json", ".tsv", ".asf", ".csv", ".h5", ""):
            continue
        skeleton = None
        if path.suffix == ".amc":
            skeleton = data / "cmu_amc/rfc/08.asf" if "/rfc/" in name else None
            skeleton = data / "cmu_amc/01/01.asf" if "cmu_hard" in name else skeleton
        for take in takes_of(path):
            own = name if take is None else f"{name}#{take}"
            if own in done:
                continue
            try:
                clip = read_clip(path, skeleton=skeleton, take=take, allow_pickle=True)
            except PoiseError:
                continue
            yield own, clip
    for path, skeleton in (pair for pair in also if pair[0].name not in done):
        yield path.name, read_clip(path, skeleton=skeleton)


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


def figures(rows: list[dict[str, Any]]) -> list[tuple[str, str, float | str, int]]:
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
            out.append(
                (
                    r["clip"],
                    "likely, Hz, at the rate that it states",
                    r["stated"]["likely"],
                    1,
                )
            )
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--also", nargs="*", default=[], metavar="AMC=ASF")
    parser.add_argument("--raw", type=Path)
    parser.add_argument("-o", "--out", type=Path, default=Path("results/rates.csv"))
    a = parser.parse_args()
    also = [(Path(x), Path(y)) for x, y in (pair.split("=") for pair in a.also)]
    rows: list[dict[str, Any]] = []
    if a.raw is not None and a.raw.exists():
        rows = [json.loads(line) for line in a.raw.read_text("utf-8").splitlines()]
    done = {r["clip"] for r in rows}
    for name, clip in clips(a.data, also, done):
        rows.append(judged(name, clip))
        if a.raw is not None:
            with a.raw.open("a", encoding="utf-8") as file:
                file.write(json.dumps(rows[-1]) + "\n")
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    a.out.parent.mkdir(parents=True, exist_ok=True)
    with a.out.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for subject, metric, value, n in figures(rows):
            table.writerow((subject, metric, value, "", n, "", "", commit, COMMAND))


if __name__ == "__main__":
    main()
