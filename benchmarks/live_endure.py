"""Four characters in real time for 50 minutes and more, driven by a client that errs.

    python benchmarks/live_endure.py --minutes 50 --runs 3 --data FOLDER --json OUT.json

`poise live --stream` runs in a process of its own, one character looks ahead; a client in this one sends
people at 30 Hz with drop-outs, NaN packets, bursts and swaps, and another connection reads the figures.
    python benchmarks/live_endure.py --plot OUT.svg --json OUT.json

Each run is a row of the JSON, which is written every minute; runs that stand there whole are not made
again. Times are of the machine as it was: where others work on it they are upper bounds.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from live_client import Sent, play, watch
from speed import machine

from live import clips_of, memory_mb, serve
from poise.live.characters import FALLS, RETURNS
from poise.motion import Clip
from poise.score.report.svg import line_plot

#: s before figures count, s after the client's end in which characters that are down may still get up.
WARMS_S, ENDS_S = 10.0, 20.0


def told(seen: Sequence[tuple[float, dict[str, Any]]], sent: Sent) -> dict[str, Any]:
    """What figures `(s, figures)` of a run say."""
    counted = [(t, s) for t, s in seen if t > WARMS_S]
    if not counted:
        return {}
    last, hz = counted[-1][1], np.array([s["hz"] for _, s in counted])
    late = np.array([s["latency_ms"] for _, s in counted])
    steps = np.array([s["step_ms"] for _, s in counted])
    # s for which each character was down or on its way up, without a break.
    longest, since = [0.0] * 4, [None] * 4
    off: list[list[float]] = [[] for _ in range(4)]
    for t, s in counted:
        for k, c in enumerate(s["characters"]):
            if c["doing"] in (FALLS, RETURNS):
                since[k] = t if since[k] is None else since[k]
                longest[k] = max(longest[k], t - since[k])
            else:
                since[k] = None
                off[k].append(c["off_mm"])
    doing = Counter(c["doing"] for _, s in counted for c in s["characters"])
    return {
        "sent": dict(sent.counts), "refused": last["refused"],
        "hz": {
            "median": float(np.median(hz)), "p1": float(np.percentile(hz, 1)), "least": float(hz.min()),
        },
        "latency_ms_beyond_buffer": {
            "p50": float(np.median(late[:, 0])), "p99": float(np.median(late[:, 1])),
            "worst minute's p99": float(late[:, 1].max()),
        },
        "step_ms": {"p50": float(np.median(steps[:, 0])), "p99": float(np.median(steps[:, 1]))},
        "steps_late": last["behind"], "resets": last["resets"], "looked_ahead": last["looked_ahead"],
        "characters": [
            {**{n: c[n] for n in ("doing", "lost", "falls", "recovered")},
             "longest_s_down": round(longest[k], 1), "off_mm_median": float(np.median(off[k] or [0]))}
            for k, c in enumerate(last["characters"])
        ],
        "share_of_time": {k: round(v / sum(doing.values()), 4) for k, v in doing.items()},
        "unrecovered": sum(c["doing"] in (FALLS, RETURNS) for c in last["characters"]),
    }  # fmt: skip


def endure(
    clips: Sequence[Clip],
    minutes: float,
    seed: int,
    ahead: int,
    buffer: float,
    keep: Callable[[dict[str, Any]], None],
) -> dict[str, Any]:
    """One run; `keep` is told what it has come to every minute."""
    seconds, four = 60 * minutes, [clips[k % len(clips)] for k in range(4)]
    process, host = serve(
        "--stream", "--characters", "4", "--lookahead", str(ahead), "--buffer", str(buffer)
    )
    row: dict[str, Any] = {
        "machine": machine(), "seed": seed, "minutes": 0.0, "whole": False,
        "clips": [c.name for c in four], "lookahead": ahead, "buffer_s": buffer, "memory_mb": [],
    }  # fmt: skip
    seen, sent, began = list[tuple[float, dict[str, Any]]](), Sent(), time.perf_counter()

    def heard(figures: dict[str, Any]) -> None:
        if "characters" in figures:
            seen.append((time.perf_counter() - began, figures))

    async def remember() -> None:
        while process.poll() is None:
            now = time.perf_counter() - began
            row["memory_mb"].append((round(now), round(memory_mb(process.pid), 1)))
            if len(row["memory_mb"]) % 6 == 0:
                keep({**row, "minutes": round(now / 60, 1), **told(seen, sent)})
            await asyncio.sleep(10)

    async def all_three() -> None:
        task = asyncio.create_task(remember())
        await asyncio.gather(
            play(f"ws://{host}/stream", four, seconds, seed, True, sent),
            watch(f"ws://{host}/live", seconds + ENDS_S, heard),
        )
        task.cancel()

    try:
        asyncio.run(all_three())
    finally:
        row["alive"] = process.poll() is None
        row["minutes"] = round((time.perf_counter() - began) / 60, 1)
        process.terminate()
        process.wait(30)
    return {**row, "whole": row["alive"], **told(seen, sent)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path())
    parser.add_argument("--clips", type=int, default=4)
    parser.add_argument("--minutes", type=float, default=50.0)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--lookahead", type=int, default=1)
    parser.add_argument("--buffer", type=float, default=0.3)
    parser.add_argument("--plot", type=Path, help="memory of the runs that stand in the JSON, SVG")
    parser.add_argument("--json", type=Path, required=True)
    o = parser.parse_args()
    if o.plot is not None:
        runs = json.loads(o.json.read_text())["runs"]
        lines = [
            (f"run {k + 1}", *np.array([(t / 60, mb) for t, mb in r["memory_mb"]]).T)
            for k, r in enumerate(runs)
        ]
        title = "Memory of four live characters"
        line_plot(lines, title, "minutes", "MB", o.plot, zero=True)
        return
    clips, rows = clips_of(o.data, o.clips), list[dict[str, Any]]()
    if o.json.exists():
        rows = [r for r in json.loads(o.json.read_text()).get("runs", []) if r["whole"]]

    def write(more: Sequence[dict[str, Any]] = ()) -> None:
        o.json.write_text(json.dumps({"runs": [*rows, *more]}, indent=1) + "\n")

    for seed in range(len(rows), o.runs):
        rows.append(endure(clips, o.minutes, seed, o.lookahead, o.buffer, lambda row: write([row])))
        write()
        print(json.dumps({k: v for k, v in rows[-1].items() if k != "memory_mb"})[:2000], flush=True)


if __name__ == "__main__":
    main()
