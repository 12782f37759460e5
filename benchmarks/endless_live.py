"""Motion without end in real time: rate, share of the steps that look ahead, falls per hour.

    python benchmarks/endless_live.py --characters 1 --cores 1 --minutes 3 --json OUT.json
    python benchmarks/endless_live.py --characters 4 --cores 2 --minutes 3 --json OUT.json

`poise live` runs in processes of its own, held to so many cores (Linux); all characters follow endless
motion, and all look ahead as far as there is time. Rows of the JSON are named by characters and cores;
what stands there of another row is kept. Times are of the machine as it was.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from speed import machine
from websockets.asyncio.client import connect

from live import serve
from poise.live.characters import FALLS, RETURNS

#: s before figures count.
WARMS_S = 20.0


async def watched(host: str, count: int, seconds: float) -> list[dict[str, Any]]:
    """Sets all characters going; the figures that pages are told from then on."""
    out, loop = list[dict[str, Any]](), asyncio.get_running_loop()
    async with connect(f"ws://{host}/live", max_size=None, ping_interval=None) as socket:
        for k in range(count):
            told = {"v": 1, "type": "dream", "character": k, "on": True}
            await socket.send(json.dumps(told))
        end = loop.time() + WARMS_S + seconds
        while loop.time() < end:
            told = await asyncio.wait_for(socket.recv(), 30.0)
            if isinstance(told, str) and (said := json.loads(told)).get("type") == "figures":
                out.append({**said, "s": loop.time() - end + seconds})
    return [f for f in out if f["s"] >= 0.0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--characters", type=int, default=1)
    parser.add_argument("--lookahead", type=int, help="characters that look ahead, by default all")
    parser.add_argument("--cores", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--json", type=Path, required=True)
    o = parser.parse_args()
    n, ahead, every = o.characters, o.characters if o.lookahead is None else o.lookahead, None
    if hasattr(os, "sched_setaffinity"):
        every = os.sched_getaffinity(0)
        # What is started now inherits it; the client goes back to all of them.
        os.sched_setaffinity(0, sorted(every)[: o.cores])
    process, host = serve("--characters", str(n), "--lookahead", str(ahead), "--buffer", "0.4")
    if every is not None:
        os.sched_setaffinity(0, every)
    try:
        seen = asyncio.run(watched(host, n, 60 * o.minutes))
    finally:
        process.terminate()
        process.wait(30)
    first, last = seen[0], seen[-1]
    hours = n * (last["s"] - first["s"]) / 3600
    doing = [c["doing"] for f in seen for c in f["characters"]]
    counted = {
        name: sum(
            b[name] - a[name] for a, b in zip(first["characters"], last["characters"], strict=True)
        )
        for name in ("lost", "falls", "recovered")
    }
    hz = np.array([f["hz"] for f in seen])
    row = {
        "machine": machine(), "characters": n, "look ahead": ahead, "cores": o.cores,
        "minutes": round((last["s"] - first["s"]) / 60, 1),
        "hz": {"median": float(np.median(hz)), "p1": round(float(np.percentile(hz, 1)), 1)},
        "step_ms": last["step_ms"], "steps_late": last["behind"] - first["behind"],
        "looked_ahead": last["looked_ahead"], **counted,
        "falls_per_hour": round(counted["falls"] / hours, 1),
        "share_away": round(sum(d in (FALLS, RETURNS) for d in doing) / len(doing), 3),
        "down_at_the_end": sum(c["doing"] in (FALLS, RETURNS) for c in last["characters"]),
    }  # fmt: skip
    rows = json.loads(o.json.read_text()) if o.json.exists() else {}
    rows[f"{n} characters, {ahead} look ahead, {o.cores} cores"] = row
    o.json.write_text(json.dumps(rows, indent=1) + "\n")
    print(json.dumps(row))


if __name__ == "__main__":
    main()
