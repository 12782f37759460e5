"""Dirt of known size on clean clips, and what the repair leaves of it beside the best filters.

    python benchmarks/repair.py --data FOLDER [--as keypoints] [--smoke] [--only white tone5] -o FILE.csv
    python benchmarks/repair.py --data FOLDER --live -o results/repair_live.csv
    python benchmarks/repair.py --data FOLDER --clean -o results/repair_clean.csv
    python benchmarks/repair.py --data FOLDER --track -o results/repair_track.csv
    python benchmarks/repair.py --data FOLDER --files -o results/repair_files.csv

FOLDER holds the development set. Every clip is dirtied so that its joints are 10 to 100 mm off on
average, repaired by `heal`, and filtered by zero-phase Butterworth filters, Savitzky-Golay filters and
the one-euro filter with the setting that an oracle chooses for the clip: the one that comes nearest to
the truth; a foot lock that is told the true contacts goes on from either (`repair_rivals.py`). The null
row does nothing. Slide is the horizontal speed of ankles and toes in frames in which
the truth's own stand: within 5 cm of their lowest and slower than 0.1 m/s.

As keypoints the joints of a clip, onto which a skeleton was fitted, are its keypoints: the dirt moves
each by itself, drop-outs are missing for 0.3 s, and repaired is what `poise doctor --fix` makes of the
clip that reading them gives. The filters act on their places, gaps interpolated.

Files are motion from video and from text whose truth nobody knows, see `repair_files.py`.
"""

from __future__ import annotations

import argparse
import csv
import random
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from itertools import zip_longest
from pathlib import Path

import numpy as np
import torch
from repair_rivals import filtered, filters, foot_lock, standing
from scipy.signal import butter, sosfiltfilt

from poise.errors import PoiseError
from poise.formats import read_clip
from poise.formats.point_fit import fit_clip
from poise.formats.point_noise import fill
from poise.jobs.track import track
from poise.kinematics import examine, heal
from poise.kinematics.repair.motion_doctor import READ_ONLY
from poise.motion import Clip, trim
from poise.motion.clip import resample
from poise.motion.keypoints import Keypoints
from poise.motion.rotations import quat_mul, rotvec_to_quat, unwrap_quats

COLUMNS = ("subject", "metric", "value", "spread", "n", "seeds", "policy", "commit", "command")
#: Clips that the repair was made with, which are not measured.
KNOWN = (
    "dataset-1_walk_normal_001",
    "dataset-1_run_normal_001",
    "dataset-1_kick_normal_001",
    "dataset-1_bow_normal_001",
    "dataset-1_punch_normal_001",
    "dataset-1_dash_normal_001",
    "02_01",
    "02_04",
    "08_02",
    "35_17",
)
SIZES_MM, LONGEST_S, SHORTEST_S, CLIPS = (10.0, 25.0, 50.0, 100.0), 10.0, 1.5, 40
#: A truth has no faults where a repair moves it by less than this (mm); recordings that are repaired as
#: they are, and dirty ones that are tracked.
CLEAN_MM, CLEAN, TRACKED = 1.0, 200, 12
CLEAN_SETS = (
    "other/bandai_bvh/**/*.bvh",
    "cmu_amc/**/*.amc",
    "cmu_bvh/**/*.bvh",
    "deepmimic_txt/*.txt",
)

Noise = tuple[np.ndarray, np.ndarray]
"""Turns `(T, J, 3)` rad about a joint's own axes, moves `(T, 3)` m of the root, both of size one."""


def white(rng: np.random.Generator, clip: Clip) -> Noise:
    """Every frame by itself."""
    return rng.standard_normal((clip.frames, len(clip.skeleton), 3)), 0.2 * rng.standard_normal(
        (clip.frames, 3)
    )


def tone(hz: float) -> Callable[[np.random.Generator, Clip], Noise]:
    """A sine of one frequency, every axis in a phase of its own."""

    def made(rng: np.random.Generator, clip: Clip) -> Noise:
        t = 2 * np.pi * hz * np.arange(clip.frames) / clip.fps
        turn = np.sin(t[:, None, None] + rng.uniform(0, 2 * np.pi, (len(clip.skeleton), 3)))
        return turn, 0.2 * np.sin(t[:, None] + rng.uniform(0, 2 * np.pi, 3))

    return made


def spikes(rng: np.random.Generator, clip: Clip) -> Noise:
    """A joint in fifty leaps away for a frame."""
    hit = rng.random((clip.frames, len(clip.skeleton), 1)) < 0.02
    return rng.standard_normal((clip.frames, len(clip.skeleton), 3)) * hit, np.zeros((clip.frames, 3))


def _slow(rng: np.random.Generator, clip: Clip, hz: float) -> np.ndarray:
    """`(T)` smooth noise below a frequency, of deviation one."""
    many = clip.frames + 200
    path = sosfiltfilt(butter(2, hz, fs=clip.fps, output="sos"), rng.standard_normal(many))[100:-100]
    return path / path.std()


def wobble(rng: np.random.Generator, clip: Clip) -> Noise:
    """The depth of one camera: the root wanders along one level direction, below 1 Hz."""
    way = rng.uniform(0, 2 * np.pi)
    path = _slow(rng, clip, 1.0)[:, None] * np.array([np.cos(way), np.sin(way), 0.0])
    return np.zeros((clip.frames, len(clip.skeleton), 3)), path


def drift(rng: np.random.Generator, clip: Clip) -> Noise:
    """The root leaves steadily in one level direction."""
    way, t = rng.uniform(0, 2 * np.pi), np.linspace(0, 1, clip.frames)
    path = t[:, None] * np.array([np.cos(way), np.sin(way), 0.0])
    return np.zeros((clip.frames, len(clip.skeleton), 3)), path


KINDS = {
    "white": white,
    "tone5": tone(5.0),
    "tone2": tone(2.0),
    "spikes": spikes,
    "wobble": wobble,
    "drift": drift,
}


def held(clip: Clip, rng: np.random.Generator) -> Clip:
    """Drop-outs: every joint stands still for 0.3 s, once in 5 s on average."""
    rot, length = np.array(clip.rot), round(0.3 * clip.fps)
    for j in range(len(clip.skeleton)):
        for _ in range(rng.poisson(clip.seconds / 5)):
            at = int(rng.integers(1, max(2, clip.frames - length)))
            rot[at : at + length, j] = rot[at - 1, j]
    return clip.replaced(rot=rot)


def dirty(clip: Clip, kind: str, mm: float, seed: int) -> Clip:
    """The clip with dirt of a kind, so that its joints are `mm` off; drop-outs have their own size."""
    rng = np.random.default_rng(seed)
    if kind == "dropouts":
        return held(clip, rng)
    parts = KINDS if kind == "all" else {kind: KINDS[kind]}
    noise = [make(rng, clip) for make in parts.values()]
    # In a mixture all kinds are alike in size.
    if kind == "all":
        noise = [_sized(clip, one, 20.0) for one in noise]
    turn, move = (np.sum([one[k] for one in noise], axis=0) for k in (0, 1))
    turn, move = _sized(clip, (turn, move), mm)
    out = _with(clip, (turn, move))
    return held(out, rng) if kind == "all" else out


def _with(clip: Clip, noise: Noise) -> Clip:
    rot = quat_mul(torch.tensor(clip.rot), rotvec_to_quat(torch.tensor(noise[0])))
    return clip.replaced(rot=unwrap_quats(rot).numpy(), root_pos=clip.root_pos + noise[1])


def _sized(clip: Clip, noise: Noise, mm: float) -> Noise:
    size = 0.02
    for _ in range(6):
        size = min(
            size * mm / max(off_mm(_with(clip, (size * noise[0], size * noise[1])), clip), 1e-6), 1.5
        )
    return size * noise[0], size * noise[1]


def off_mm(a: Clip, b: Clip) -> float:
    """mm between joints on average."""
    return 1e3 * float(np.linalg.norm(a.positions() - b.positions(), axis=-1).mean())


def seen(clip: Clip, kind: str, mm: float, seed: int) -> Keypoints:
    """The clip's joints as keypoints with dirt of a kind, each `mm` off on average; a mixture has all
    kinds, alike in size."""
    rng, pos = np.random.default_rng(seed), clip.positions()

    def sized(noise: np.ndarray) -> np.ndarray:
        return noise * (mm / 1e3 / np.linalg.norm(noise, axis=-1).mean())

    def moves(kind: str) -> np.ndarray:
        turn, move = KINDS[kind](rng, clip)
        return sized(turn if turn.any() else np.broadcast_to(move[:, None], turn.shape))

    if kind != "dropouts":
        pos = pos + sized(np.sum([moves(k) for k in (KINDS if kind == "all" else (kind,))], axis=0))
    if kind in ("dropouts", "all"):
        length = round(0.3 * clip.fps)
        for j in range(len(clip.skeleton)):
            for _ in range(rng.poisson(clip.seconds / 5)):
                at = int(rng.integers(1, max(2, clip.frames - length)))
                pos[at : at + length, j] = np.nan
    return Keypoints(clip.skeleton.names, pos, clip.fps, clip.name)


def smoothed(points: Keypoints, one: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Places `(T, J, 3)` m of keypoints with the filter on them."""
    whole = np.stack([fill(points.positions[:, k]) for k in range(len(points.names))], 1)
    return one(whole.reshape(len(whole), -1)).reshape(whole.shape)


def measured(here: np.ndarray, truth: Clip) -> dict[str, float]:
    """The errors of joints' places `(T, J, 3)` m: distance, end of the path, slide of feet that stand
    in truth, share of its jerk."""
    feet = [j for j, n in enumerate(truth.skeleton.names) if "foot" in n.lower() or "toe" in n.lower()]
    there = truth.positions()
    stands = standing(there[:, feet], truth.fps)

    def slide(p: np.ndarray) -> float:
        step = np.linalg.norm(np.diff(p[:, feet, :2], axis=0), axis=-1) * truth.fps
        return 1e3 * float(step[stands].mean()) if stands.any() else float("nan")

    jerk = [float(np.linalg.norm(np.diff(p, n=3, axis=0), axis=-1).mean()) for p in (here, there)]
    return {
        "distance_mm": 1e3 * float(np.linalg.norm(here - there, axis=-1).mean()),
        "end_mm": 1e3 * float(np.linalg.norm(here[-1, 0] - there[-1, 0])),
        "slide_more_mm_per_s": slide(here) - slide(there),
        "jerk_ratio": jerk[0] / max(jerk[1], 1e-9),
    }


def attempts(clip: Clip, kind: str, mm: float, seed: int) -> dict[str, np.ndarray] | None:
    """Places `(T, J, 3)` m of the dirty clip, of the best filter's, of the repaired one, and of a foot
    lock with true contacts on the first two; None where the repair has other frames."""
    broken = dirty(clip, kind, mm, seed)
    fixed = heal(broken)
    if fixed.frames != clip.frames:
        return None
    tried = [filtered(broken, one) for _, one in filters(clip.fps, clip.frames)]
    best = min(tried, key=lambda one: off_mm(one, clip))
    out = {"null": broken, "best filter": best, "repair": fixed}
    for name, one in (("foot lock", broken), ("best filter, then foot lock", best)):
        if (locked := foot_lock(one, clip)) is not None:
            out[name] = locked
    return {name: one.positions() for name, one in out.items()}


def attempts_at_points(clip: Clip, kind: str, mm: float, seed: int) -> dict[str, np.ndarray] | None:
    """The same for the clip's joints as keypoints, which have no legs to lock."""
    broken, there = seen(clip, kind, mm, seed), clip.positions()
    fixed = heal(fit_clip(broken))
    if fixed.frames != clip.frames:
        return None
    whole = smoothed(broken, lambda x: x)
    tried = [*(smoothed(broken, one) for _, one in filters(clip.fps, clip.frames)), whole]
    best = min(tried, key=lambda p: float(np.linalg.norm(p - there, axis=-1).mean()))
    return {"null": whole, "best filter": best, "repair": fixed.positions()}


def fitted_of(clips: Iterable[Clip], count: int) -> Iterator[Clip]:
    """Clips as a skeleton follows their joints, those that show a whole body."""
    for clip in clips:
        with suppress(PoiseError):
            made = fit_clip(Keypoints(clip.skeleton.names, clip.positions(), clip.fps, clip.name))
            if made.frames == clip.frames:
                yield made
                count -= 1
        if not count:
            return


def recordings(data: Path, globs: Iterable[str], seed: int = 64) -> Iterator[tuple[Path, Clip]]:
    """Recordings of several sets in turns, drawn by a seed: the first `LONGEST_S`, at 30 to 60 Hz."""
    sets = [sorted(data.glob(pattern)) for pattern in globs]
    for files in sets:
        random.Random(seed).shuffle(files)
    for path in (p for row in zip_longest(*sets) for p in row if p is not None):
        try:
            clip = read_clip(path)
        except PoiseError:
            continue
        if clip.seconds >= SHORTEST_S:
            clip = trim(clip, 0, min(clip.frames, int(LONGEST_S * clip.fps)))
            yield path, resample(clip, 30.0) if clip.fps > 60 else clip


def clips_of(data: Path, count: int) -> Iterator[Clip]:
    """Clips that nobody tuned on, of Bandai and CMU in turns: those that are as they are after a repair,
    since the truth must have no faults."""
    for path, clip in recordings(data, ("other/bandai_bvh/**/*.bvh", "cmu_amc/**/*.amc")):
        if path.stem in KNOWN:
            continue
        whole = heal(clip)
        if whole.frames == clip.frames and off_mm(whole, clip) <= CLEAN_MM:
            yield clip
            count -= 1
        if not count:
            return


def clean_rows(data: Path, count: int) -> Iterator[tuple[str, str, list[float]]]:
    """The repair's changes of recordings: of those without a fault that the doctor names, and of all."""
    seen: dict[str, list[tuple[float, float, float]]] = {"no fault named": [], "all": []}
    for path, clip in recordings(data, CLEAN_SETS):
        whole = heal(clip)
        if whole.frames != clip.frames:
            continue
        off = 1e3 * np.linalg.norm(whole.positions() - clip.positions(), axis=-1)
        change = (float(off.mean()), float(off.max()), float(off[-1, 0]))
        sound = not [f for f in examine(clip).faults if f.kind not in READ_ONLY]
        seen["all"].append(change)
        if sound:
            seen["no fault named"].append(change)
            if change[0] > 1.0 or change[1] > 20.0:
                print(path, [round(x, 1) for x in change], file=sys.stderr)
        if len(seen["all"]) == count:
            break
    for name, made in seen.items():
        for k, metric in enumerate(("mean_mm", "greatest_mm", "end_mm")):
            yield name, metric, [row[k] for row in made]
        yield (
            name,
            "share of clips with mean <= 1, greatest <= 20, end <= 10 mm",
            [float(np.mean([m <= 1 and g <= 20 and e <= 10 for m, g, e in made]))],
        )


def track_rows(
    clips: list[Clip], kinds: Iterable[str], sizes: Iterable[float]
) -> Iterator[tuple[str, str, list[float]]]:
    """Dirt that `poise track` follows: motion done to its end, beside the estimate that it follows, and
    beside what it makes of the truth."""
    whole = [track(clip) for clip in clips]
    yield "truth", "done", [float(np.mean([not made.failures for made in whole]))]
    ours = [
        measured(made.clip.positions(), clip) if made.clip.frames == clip.frames else None
        for made, clip in zip(whole, clips, strict=True)
    ]
    for metric in ("distance_mm", "end_mm", "slide_more_mm_per_s", "jerk_ratio"):
        yield "truth", f"tracked: {metric}", [one[metric] for one in ours if one]
    for kind in kinds:
        for mm in sizes if kind != "dropouts" else (0.0,):
            told: dict[str, list[float]] = {}
            for k, clip in enumerate(clips):
                broken = dirty(clip, kind, mm, k)
                made, estimate = track(broken), heal(broken)
                parts = {"tracked": made.clip, "estimate": estimate, "dirty": broken}
                told.setdefault("done", []).append(float(not made.failures))
                for name, one in parts.items():
                    if one.frames == clip.frames:
                        found = measured(one.positions(), clip)
                        for metric, value in found.items():
                            told.setdefault(f"{name}: {metric}", []).append(value)
                        if name == "tracked" and (own := ours[k]) and estimate.frames == clip.frames:
                            more = found["distance_mm"] - own["distance_mm"] - off_mm(estimate, clip)
                            told.setdefault("tracked: mm beyond truth's and estimate's", []).append(more)
            told["done"] = [float(np.mean(told["done"]))]
            for metric, values in told.items():
                yield (f"{kind} {mm:g} mm" if mm else kind), metric, values


def write(out: Path, rows: Iterable[tuple[str, str, list[float]]], command: str) -> None:
    """The rows: the median of the values, and their quartiles."""
    show = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(show, capture_output=True, text=True).stdout.strip()
    out.parent.mkdir(parents=True, exist_ok=True)
    with out.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for subject, metric, values in rows:
            low, middle, high = np.nanquantile(values, (0.25, 0.5, 0.75))
            spread = f"{low:.3g} to {high:.3g}"
            writer.writerow(
                (subject, metric, f"{middle:.4g}", spread, len(values), 1, "", commit, command)
            )
            file.flush()
            print(subject, metric, f"{middle:.4g}", spread, file=sys.stderr)


def dirt_rows(
    clips: list[Clip], kinds: Iterable[str], sizes: Iterable[float], points: bool
) -> Iterator[tuple[str, str, list[float]]]:
    """The errors of the dirty clip, of the best filter's and of the repaired one."""
    try_out = attempts_at_points if points else attempts
    for kind in kinds:
        for mm in sizes if kind != "dropouts" else (0.0,):
            left: dict[str, list[dict[str, float]]] = {}
            for k, clip in enumerate(clips):
                made = try_out(clip, kind, mm, k)
                if made is None:
                    continue
                for name, places in made.items():
                    left.setdefault(name, []).append(measured(places, clip))
            subject = (f"{kind} {mm:g} mm" if mm else kind) + (" of keypoints" if points else "")
            ratio = [
                a["distance_mm"] / b["distance_mm"]
                for a, b in zip(left["repair"], left["best filter"], strict=True)
            ]
            yield subject, "distance over best filter's", ratio
            yield subject, "share above 1.25", [float(np.mean([r > 1.25 for r in ratio]))]
            for name, made in left.items():
                for metric in made[0]:
                    yield subject, f"{name}: {metric}", [r[metric] for r in made]


def main() -> None:
    """Measures and writes the rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--as", dest="form", choices=("rotations", "keypoints"), default="rotations")
    parser.add_argument("--only", nargs="*", help="kinds of dirt, by default all that there are")
    parser.add_argument("--sizes", nargs="*", type=float, default=SIZES_MM)
    parser.add_argument("--clips", type=int, default=CLIPS)
    parser.add_argument("--smoke", action="store_true", help="three clips, one size")
    parser.add_argument("--live", action="store_true", help="streams, see repair_live.py")
    parser.add_argument("--clean", action="store_true", help="recordings as they are")
    parser.add_argument("--files", action="store_true", help="motion from video and from text")
    parser.add_argument("--track", action="store_true", help="what a body makes of dirt")
    parser.add_argument("-o", "--out", type=Path, required=True)
    o = parser.parse_args()
    torch.set_num_threads(1)
    count, sizes = (3, (25.0,)) if o.smoke else (o.clips, o.sizes)
    command = "python benchmarks/repair.py --data FOLDER"
    if o.live:
        import repair_live as live

        clips = list(clips_of(o.data, min(count, live.CLIPS)))
        rows, command = live.live_rows(clips, sizes if o.smoke else live.SIZES_MM), f"{command} --live"
    elif o.clean:
        rows, command = clean_rows(o.data, count if o.smoke else CLEAN), f"{command} --clean"
    elif o.files:
        import repair_files as from_video

        rows, command = from_video.file_rows(o.data, o.smoke), f"{command} --files"
    elif o.track:
        clips = list(clips_of(o.data, min(count, TRACKED)))
        rows = track_rows(clips, o.only or ("white", "tone5", "all"), sizes)
        command = f"{command} --track"
    else:
        points = o.form == "keypoints"
        clips = list(
            fitted_of(clips_of(o.data, 2 * count), count) if points else clips_of(o.data, count)
        )
        rows = dirt_rows(clips, o.only or [*KINDS, "dropouts", "all"], sizes, points)
        command = f"{command} --as {o.form}"
    command += f" --clips {o.clips}" if o.clips != CLIPS else ""
    command += f" --only {' '.join(o.only)}" if o.only else ""
    command += f" --sizes {' '.join(f'{x:g}' for x in o.sizes)}" if o.sizes != SIZES_MM else ""
    write(o.out, rows, f"{command} -o results/{o.out.name}")


if __name__ == "__main__":
    main()
