"""What motions of 1, 10 and 60 minutes cost: time and memory of `info`, `doctor` and `track`.

    python benchmarks/lengths.py --clips FOLDER --json benchmarks/lengths.json --svg docs/lengths.svg

FOLDER holds walks and runs of one person. They are joined, one after another in an order drawn by the
seed, each from its frame that is most like the end of the one before and turned by up to 30
degrees towards the origin, until the motion is long enough. Each command runs in a process of its own;
`track` is the policy alone with recovery, and the plot is of its memory.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from speed import machine

from poise.formats import read_clip, write_clip
from poise.learn.checkpoint import write_atomic
from poise.motion import Clip, resample
from poise.motion.rotations import quat_mul, slerp
from poise.score.report.svg import line_plot

RATE = 30.0
#: Frames from one clip to the next, and how far the next may be turned by, rad.
SEAM, MOST_TURN = 12, np.pi / 6
#: s between two looks at the memory of a process, and how many of them the JSON keeps.
LOOK_S, KEPT = 1.0, 100
PAGE_MB = os.sysconf("SC_PAGE_SIZE") / 2**20
COMMANDS: dict[str, list[str]] = {
    "info": [],
    "doctor": [],
    "track": ["--controller", "policy", "--recover", "--no-supports", "--json"],
}


def joined(clips: list[Clip], minutes: float, seed: int) -> Clip:
    """One motion of so many minutes at 30 Hz."""
    rng = np.random.default_rng(seed)
    clips = [resample(c, RATE) for c in clips]
    root, rot, count = [clips[0].root_pos], [clips[0].rot], clips[0].frames
    while count < 60 * minutes * RATE:
        one, two = _next(clips[rng.integers(len(clips))], root[-1], rot[-1])
        share = (np.arange(SEAM) + 1) / (SEAM + 1)
        low, high = (torch.tensor(x).expand(SEAM, *x.shape) for x in (rot[-1][-1], two[0]))
        between = slerp(low, high, torch.tensor(share)[:, None].expand(-1, rot[0].shape[1])).numpy()
        steps = root[-1][-1] + share[:, None] * (one[0] - root[-1][-1])
        root += [steps, one]
        rot += [between, two]
        count += SEAM + len(one)
    frames = round(60 * minutes * RATE) + 1
    whole = clips[0].replaced(name=f"{minutes:g} minutes", cyclic=False)
    return whole.replaced(root_pos=np.concatenate(root)[:frames], rot=np.concatenate(rot)[:frames])


def _next(clip: Clip, root: np.ndarray, rot: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The clip from that frame of its first half which is most like the last one, moved and turned."""
    half = max(1, clip.frames // 2)
    alike = np.abs((clip.rot[:half, 1:] * rot[-1, 1:]).sum(-1)).sum(-1)
    start = int(alike.argmax())
    pos, turn = clip.root_pos[start:], clip.rot[start:]
    now, was, home = _way(pos[: SEAM + 1]), _way(root[-SEAM - 1 :]), _way([root[-1], np.zeros(3)])
    wish = (home - was + np.pi) % (2 * np.pi) - np.pi
    angle = was - now + np.clip(wish, -MOST_TURN, MOST_TURN)
    about = torch.tensor([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])
    turn = turn.copy()
    turn[:, 0] = quat_mul(about.expand(len(turn), 4), torch.tensor(turn[:, 0])).numpy()
    c, s = np.cos(angle), np.sin(angle)
    moved = (pos - pos[0]) @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    step = (SEAM + 1) * (root[-1] - root[-2])
    return moved + np.array([*(root[-1] + step)[:2], pos[0, 2]]), turn


def _way(path: Any) -> float:
    """The direction about Z from the first to the last of some places, rad."""
    x, y, _ = path[-1] - path[0]
    return float(np.arctan2(y, x))


def run(argv: list[str]) -> tuple[dict[str, Any], list[tuple[float, float]], str]:
    """One command: seconds, CPU seconds and peak memory; its memory over time, (s, MB); its stdout."""
    began, seen = time.perf_counter(), list[tuple[float, float]]()
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(argv, stdout=said, stderr=subprocess.DEVNULL)
        ended = threading.Event()

        def look() -> None:
            while not ended.wait(LOOK_S):
                try:
                    pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
                except (OSError, IndexError):
                    return
                seen.append((time.perf_counter() - began, pages * PAGE_MB))

        watch = threading.Thread(target=look)
        watch.start()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        ended.set()
        watch.join()
        said.seek(0)
        text = said.read().decode()
        # 3 is done, but lost.
        if process.returncode not in (0, 3):
            raise SystemExit(f"{' '.join(argv)}:\n{text[-2000:]}")
    return (
        {
            "wall_s": round(time.perf_counter() - began, 2),
            "cpu_s": round(used.ru_utime + used.ru_stime, 2),
            "peak_mb": round(used.ru_maxrss / 1024),
        },
        seen,
        text,
    )


def outcome(said: str, out: Path, source: Path) -> dict[str, Any]:
    """What tracking came to: the score, and how far apart the ends of both paths are."""
    result = json.loads(said)["result"]
    score = result["score"]
    source_root, root = read_clip(source).root_pos, read_clip(out / "simulated.bvh").root_pos
    told = {k: score[k] for k in ("succ", "mpjpe_global_mm", "foot_slide_mm_per_s") if k in score}
    return told | {
        "minutes_simulated": round(len(root) / RATE / 60, 2),
        "ends_apart_m": round(float(np.hypot(*(root[-1] - source_root[-1])[:2])), 3),
        "report_mb": round((out / "report.html").stat().st_size / 2**20, 1),
        "outcome": result["outcome"],
        "sentence": result["sentence"],
        "losses": len(result["failures"]),
    }


def draw(rows: dict[str, Any], path: Path | None) -> None:
    """The memory of `track` over the share of its time that is over."""
    lines: list[tuple[str, list[float], list[float]]] = []
    for name, row in rows.items():
        if seen := row.get("memory_mb"):
            share = [100 * t / row["wall_s"] for t in row["memory_s"]]
            lines.append((name.removeprefix("track, "), share, seen))
    if path is not None and lines:
        line_plot(lines, "Memory of poise track", "% of its time", "MB", path, zero=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--clips", type=Path, required=True)
    parser.add_argument("--minutes", type=float, nargs="+", default=[1.0, 10.0, 60.0])
    parser.add_argument("--verbs", nargs="+", default=list(COMMANDS), choices=list(COMMANDS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--svg", type=Path)
    a = parser.parse_args()
    files = sorted(p for p in a.clips.iterdir() if p.suffix in (".amc", ".bvh"))
    clips = [read_clip(p) for p in files]
    said: dict[str, Any] = json.loads(a.json.read_text()) if a.json.exists() else {}
    rows: dict[str, Any] = said.setdefault("rows", {})
    for minutes in a.minutes:
        with tempfile.TemporaryDirectory() as folder:
            source = Path(folder) / "long.bvh"
            write_clip(joined(clips, minutes, a.seed), source)
            for verb in a.verbs:
                out = Path(folder) / verb
                more = [*COMMANDS[verb], "-o", str(out)] if verb == "track" else []
                row, seen, text = run([sys.executable, "-m", "poise", verb, str(source), *more])
                row["file_mb"] = round(source.stat().st_size / 2**20, 1)
                if verb == "track":
                    kept = seen[:: -(-len(seen) // KEPT)] if seen else []
                    times, memory = [round(t) for t, _ in kept], [round(m) for _, m in kept]
                    row |= outcome(text, out, source) | {"memory_s": times, "memory_mb": memory}
                rows[f"{verb}, {minutes:g} minutes"] = row
                told = {"command": "benchmarks/lengths.py", "machine": machine(), "seed": a.seed}
                said |= told | {"clips": [p.stem for p in files]}
                write_atomic(a.json, (json.dumps(said, indent=1) + "\n").encode())
    draw(rows, a.svg)


if __name__ == "__main__":
    main()
