"""What `poise track` gives a user: the motion on the skeleton that came in, beside its source.

    python benchmarks/delivered.py --data FOLDER --json FILE [--set bandai-all cmu library held-out ...]
        [--clips LIBRARY] [--every N] [--budget STEPS] [--workers 2]

Each clip goes through `poise.track` as it comes, with lookahead and with a search where it is lost so.
Joints are compared on the skeleton that came in, after retargeting to the body and back and with
standing feet held, at 30 Hz; slide is that of the character's soles. "estimators" are files of real
pose estimators (the folder "noisy"). "noise 1 cm" adds noise of 1 cm to the joints' places of four
generated motions, which then come in as keypoints, "video" what a video estimator does to four clips of
CMU: the motion is compared with its truth. Sets are those of `lookahead.py`; FILE grows clip by clip.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lookahead_sets import FILES, LIBRARIES, clips_of

from poise import track
from poise.errors import PoiseError
from poise.formats import read_clip
from poise.jobs.result import Result
from poise.jobs.track.tracking import read_motion
from poise.learn.checkpoint import write_atomic
from poise.metrics import jerk
from poise.motion import Clip, resample
from poise.motion.keypoints import Keypoints
from poise.motion.noise import VIDEO, perturb_clip
from poise.plan import LookaheadConfig

#: Hz, at which motions are compared; cut-off (Hz) of the low-pass on what has noise.
RATE, CUTOFF = 30.0, 4.0
#: Outputs of a motion diffusion model, and which of them noise of 1 cm is put on.
GENERATED, TAKES = "other/text_to_motion/mdm_results_pred.npy", (0, 8, 16, 24)
NOISY = ("noise 1 cm", "video")
#: Figures of which tables have medians.
FIGURES = (
    "error_mm", "root_error_mm", "jerk_ratio", "slide", "source_slide", "simulated_slide",
    "seconds_per_second",
)  # fmt: skip


def sources(a: argparse.Namespace, name: str) -> dict[str, Path | Clip]:
    """The clips of a set."""
    if name == "estimators":
        found = [
            f for f in sorted((a.data / "noisy").rglob("*")) if f.suffix in (".trc", ".bvh", ".mot")
        ]
        return {f.stem: f for f in found}
    if name in NOISY:
        few = list(clips_of("cmu", a.data, None, a.json.parent).items())[::16]
        if name == NOISY[0]:
            made = a.data / GENERATED
            return {f"mdm {k}": read_clip(made, take=str(k), allow_pickle=True) for k in TAKES}
        return dict(few[:4])
    return clips_of(name, a.data, a.clips, a.cache or a.json.parent / "cache")


def joints(clip: Clip) -> torch.Tensor:
    """`(T, J, 3)` m of the joints of a clip, at `RATE`."""
    return torch.tensor(resample(clip, RATE).positions()).float()


def beside(made: torch.Tensor, truth: torch.Tensor) -> dict[str, float]:
    """Errors of joints in all frames, mm, in the world and about the root, and mean jerk, m/s^3."""
    n = min(len(made), len(truth))
    made, truth = made[:n], truth[:n]
    about = (made - made[:, :1]) - (truth - truth[:, :1])
    errors = {"error_mm": made - truth, "root_error_mm": about}
    out = {k: 1000.0 * float(v.norm(dim=-1).mean()) for k, v in errors.items()}
    return out | {"jerk": float(jerk(made[None], RATE).mean())}


def measured(name: str, source: Path | Clip, kind: str, budget: float) -> dict[str, Any]:
    """One clip by `poise track`."""
    torch.set_num_threads(1)
    how = {"threads": 1, "lookahead": LookaheadConfig().with_budget(budget)}
    try:
        clip = source if isinstance(source, Clip) else read_clip(source)
        begun = time.perf_counter()
        if kind in NOISY:
            return {"clip": name} | noisy(clip, kind, how)
        motion = clip if isinstance(source, Clip) else read_motion(source)
        done = track(motion, **how)
        spent = time.perf_counter() - begun
        truth, made = joints(done.placed.source), joints(done.clip)
    except PoiseError as problem:
        return {"clip": name, "refused": str(problem)}
    found, of = beside(made, truth), beside(truth, truth)
    figures = next(iter(done.card.delivered))
    return {
        "clip": name, "controller": done.controller, "whole": done.card.succ,
        "tracked": done.card.tracked, "needs": [dict(n) for n in done.card.needs],
        "failed_s": list(done.failed_s), **found, "jerk_ratio": found["jerk"] / of["jerk"],
        "slide": figures["delivered"]["point_slide_mm_per_s"],
        "simulated_slide": figures["simulated"]["point_slide_mm_per_s"],
        "source_slide": figures["source"]["point_slide_mm_per_s"],
        "seconds_per_second": spent / done.placed.source.seconds,
    }  # fmt: skip


def noisy(clip: Clip, kind: str, how: dict[str, Any]) -> dict[str, Any]:
    """A clip with noise beside its known truth: how near and how jerky the input and the result are."""
    clip = resample(clip, RATE)
    truth = torch.tensor(clip.positions()).float()
    if kind == "video":
        seen = perturb_clip(clip, VIDEO, 0)
        done: Result = track(seen, **how)
        came = torch.tensor(seen.positions()).float()
    else:
        off = 0.01 / np.sqrt(3.0) * np.random.default_rng(0).standard_normal(truth.shape)
        came = truth + torch.tensor(off).float()
        points = Keypoints(clip.skeleton.names, came.numpy().astype(float), RATE, name=clip.name)
        done = track(points, smooth_hz=CUTOFF, **how)
    made = torch.tensor(resample(done.clip, RATE).positions()).float()
    names, own = clip.skeleton.names, done.clip.skeleton.names
    both = [n for n in names if n in own]
    rows = [names.index(n) for n in both]
    made, came, truth = made[:, [own.index(n) for n in both]], came[:, rows], truth[:, rows]
    before, after = beside(came, truth), beside(made, truth)
    out = {
        "whole": done.card.succ,
        "controller": done.controller,
        "truth_jerk": beside(truth, truth)["jerk"],
    }
    return out | {f"input_{k}": v for k, v in before.items()} | after


def table(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares and medians of a set."""
    done = [r for r in rows if "refused" not in r]
    out: dict[str, Any] = {"clips": len(rows), "refused": len(rows) - len(done)}
    if not done:
        return out
    whole = [r for r in done if r["whole"] == 1.0]
    out["whole"] = len(whole)
    out["tracked"] = sum(r.get("tracked", r["whole"]) == 1.0 for r in done)
    for by in ("lookahead", "search", "policy"):
        out[by] = sum(r["controller"] == by for r in whole)
    if "input_jerk" in done[0]:
        out["nearer"] = sum(r["error_mm"] < r["input_error_mm"] for r in done)
        out["nearer_about_the_root"] = sum(r["root_error_mm"] < r["input_root_error_mm"] for r in done)
        return out | {"half_the_jerk": sum(r["jerk"] <= 0.5 * r["input_jerk"] for r in done)}
    out |= {k: round(statistics.median(r[k] for r in whole or done), 2) for k in FIGURES}
    clean = [r["slide"] <= max(r["source_slide"], 40.0) for r in whole or done]
    return out | {"slide_as_source": round(statistics.fmean(clean), 3)}


def main() -> None:
    """Measures what FILE does not hold."""
    p = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    p.add_argument("--data", type=Path, required=True, metavar="FOLDER")
    p.add_argument("--clips", type=Path, metavar="LIBRARY", help="of the sets library and held-out")
    p.add_argument("--json", type=Path, required=True, metavar="FILE")
    sets = (*FILES, *LIBRARIES, "estimators", *NOISY)
    p.add_argument("--set", nargs="+", choices=sets, default=["bandai", "cmu", "estimators", *NOISY])
    p.add_argument("--every", type=int, default=1, metavar="N", help="take every N-th clip")
    p.add_argument("--budget", type=float, default=LookaheadConfig().budget, metavar="STEPS")
    p.add_argument("--workers", type=int, default=2)
    p.add_argument("--cache", type=Path, help="a folder for the library that is read")
    a = p.parse_args()
    rows: dict[str, list[dict[str, Any]]] = {}
    if a.json.exists():
        rows = json.loads(a.json.read_text())["clips"]
    command = (
        "python benchmarks/delivered.py --data FOLDER --clips LIBRARY --json benchmarks/delivered.json"
    )
    # A forked child may wait for threads that it does not have.
    with ProcessPoolExecutor(a.workers, get_context("spawn")) as pool:
        running = []
        for name in a.set:
            key = name if a.budget == LookaheadConfig().budget else f"{name}, budget {a.budget:g}"
            have = {r["clip"] for r in rows.get(key, [])}
            clips = sorted(sources(a, name).items())[:: a.every]
            todo = [(n, c) for n, c in clips if n not in have]
            running += [(key, pool.submit(measured, n, c, name, a.budget)) for n, c in todo]
        for key, one in running:
            rows.setdefault(key, []).append(one.result())
            tables = {k: table(v) for k, v in rows.items()}
            text = json.dumps({"command": command, "tables": tables, "clips": rows}, indent=1)
            write_atomic(a.json, text.encode())
            print(key, rows[key][-1], flush=True)


if __name__ == "__main__":
    try:
        main()
    except PoiseError as problem:
        sys.exit(str(problem))
