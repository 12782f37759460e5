"""VMC by an independent client in real time: how far the character is off, and the same clip offline.

    python benchmarks/live_vmc.py CLIP ... --json benchmarks/live_vmc.json

`poise live --vmc` runs in a process of its own. python-osc sends each clip once, on a VRM model, at
30 Hz: it stands in its first pose for 3 s and then does the motion. How far the character is from its
goal is what `poise live` tells pages meanwhile; offline the same policy tracks the same frames, those
3 s too, of which the motion counts. What `--vmc-out` sends is heard, too: it must be whole frames of
the model that came in.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import socket
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from live_client import watch
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder
from pythonosc.udp_client import SimpleUDPClient
from speed import machine

from live import serve
from poise.errors import PoiseError
from poise.formats import read_clip
from poise.jobs.track import track
from poise.kinematics import retarget
from poise.live.vmc import messages, standard, t_pose, to_unity
from poise.motion import Clip, resample

#: s that it stands before the motion, Hz of the messages.
STANDS_S, RATE = 3.0, 30.0


def free_port() -> int:
    """A UDP port that nothing listens on."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def standing_first(clip: Clip) -> Clip:
    """The clip at 30 Hz, its first pose held for `STANDS_S` before it."""
    timed = resample(clip, RATE)
    at = np.maximum(np.arange(timed.frames + round(STANDS_S * RATE)) - round(STANDS_S * RATE), 0)
    return timed.replaced(root_pos=timed.root_pos[at], rot=timed.rot[at])


def send(clip: Clip, port: int) -> float:
    """Sends a clip that stands first, a bundle a frame; `time.perf_counter()` at which it moves."""
    client, began = SimpleUDPClient("127.0.0.1", port), time.perf_counter()
    for step in range(clip.frames):
        pos = clip.skeleton.offsets.copy()
        pos[0] = clip.root_pos[step]
        places, turns = to_unity(pos, clip.rot[step])
        bundle = OscBundleBuilder(IMMEDIATELY)  # type: ignore[arg-type]
        bundle.add_content(_message("/VMC/Ext/OK", 1))
        bundle.add_content(_message("/VMC/Ext/T", step / RATE))
        for name, place, turn in zip(clip.skeleton.names, places, turns, strict=True):
            numbers = (float(x) for x in (*place, *turn))
            bundle.add_content(_message("/VMC/Ext/Bone/Pos", name, *numbers))
        client.send(bundle.build())
        time.sleep(max(0.0, began + (step + 1) / RATE - time.perf_counter()))
    return began + STANDS_S


def _message(address: str, *values: Any) -> Any:
    made = OscMessageBuilder(address)
    for value in values:
        made.add_arg(value)
    return made.build()


def live(clip: Clip, buffer: float) -> dict[str, Any]:
    """One run in real time."""
    into, out = free_port(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.bind(("127.0.0.1", 0))
    out.settimeout(0.5)
    heard, bones, over = [0], set[str](), threading.Event()

    def listen() -> None:
        while not over.is_set():
            try:
                told = messages(out.recv(65_507))
            except (TimeoutError, PoiseError):
                continue
            heard[0] += 1
            bones.update(str(m.arguments[0]) for m in told if m.address == "/VMC/Ext/Bone/Pos")

    process, host = serve(
        "--vmc", str(into), "--vmc-out", f"127.0.0.1:{out.getsockname()[1]}", "--buffer", str(buffer)
    )  # fmt: skip
    ear, seen = threading.Thread(target=listen), list[tuple[float, dict[str, Any]]]()
    ear.start()

    async def both() -> float:
        watching = asyncio.create_task(
            watch(
                f"ws://{host}/live", clip.seconds + 2.0,
                lambda f: seen.append((time.perf_counter(), f)) if "characters" in f else None,
            )
        )  # fmt: skip
        await asyncio.sleep(1.0)
        moves = await asyncio.to_thread(send, clip, into)
        await watching
        return moves

    try:
        moves = asyncio.run(both())
    finally:
        over.set()
        process.terminate()
        process.wait(30)
        ear.join()
        out.close()
    last = moves + buffer + clip.seconds - STANDS_S
    during = [f["characters"][0] for t, f in seen if moves + buffer < t < last]
    return {
        "off_mm": {"mean": round(float(np.mean([c["off_mm"] for c in during])), 1),
                   "figures": len(during)},
        "lost": seen[-1][1]["characters"][0]["lost"], "refused": seen[-1][1]["refused"],
        "vmc_out": {"frames": heard[0], "bones": len(bones)},
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--buffer", type=float, default=0.3)
    parser.add_argument("--json", type=Path, required=True)
    o = parser.parse_args()
    rows = list[dict[str, Any]]()
    for path in o.clips:
        own = read_clip(path)
        clip = standing_first(retarget(own, t_pose(standard()))[0])
        r = track(clip, controller="policy").evaluation.rollouts
        off = 1000 * (r.pos[0] - r.ref_pos[0]).norm(dim=-1).mean(-1)
        offline = float(off[round(STANDS_S * r.fps) : clip.frames].mean())
        row = {"clip": path.stem, "seconds": round(clip.seconds, 1), "offline_mm": round(offline, 1)}
        rows.append({**row, **live(clip, o.buffer)})
        print(json.dumps(rows[-1]), flush=True)
        o.json.write_text(
            json.dumps({"machine": machine(), "buffer_s": o.buffer, "clips": rows}, indent=1) + "\n"
        )


if __name__ == "__main__":
    main()
