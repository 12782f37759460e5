"""Jobs that take no time, in a module that imports nothing of Poise."""

from __future__ import annotations

import json
import os
import signal
import struct
import sys
import time
from pathlib import Path
from typing import Any

HEADER = {"home": ".bvh", "frames": 86, "format": "bvh", "unit_m": 0.0254, "up_axis": "Z"}


def toy_work(argv: list[str], folder: Path) -> None:
    """A verb: it says how far it is, and writes a motion; its first word names what befalls it."""
    out = folder / argv[argv.index("-o") + 1] if "-o" in argv else folder / argv[2]
    sys.stderr.write("looking ahead, 40 % done, 0:01 left\n")
    sys.stderr.flush()
    fate = next((w.removeprefix("--seed=") for w in argv if "--seed=" in w), "")
    fate = argv[argv.index("--seed") + 1] if "--seed" in argv else fate
    if fate == "9":
        os.kill(os.getpid(), signal.SIGKILL)
    if fate == "60":
        draw(folder / "drawn.bin")
        time.sleep(60)
    motion = out if out.suffix else out / "simulated.bvh"
    motion.parent.mkdir(parents=True, exist_ok=True)
    motion.write_text(" ".join(argv))
    told = {"outputs": {"simulated": str(motion.relative_to(folder))}, "result": {}, "exit_code": 0}
    told["notes"] = ["A note."]
    sys.stdout.write(json.dumps(told))
    sys.stdout.flush()


def draw(path: Path) -> None:
    """Three frames of two joints, and the beginning of a fourth."""
    words = json.dumps({"parents": [-1, 0]}).encode().ljust(24)
    rows = struct.pack("<21f", *(float(v) for k in range(3) for v in (k, *range(10 * k, 10 * k + 6))))
    path.write_bytes(struct.pack("<I", len(words)) + words + rows + rows[:9])


def toy_look(path: str, reading: dict[str, Any], room: str, folder: Path) -> None:
    """What the page draws."""
    words = json.dumps(HEADER).encode()
    (Path(room) / "figure.bin").write_bytes(struct.pack("<I", len(words)) + words)
    (Path(room) / "judged.json").write_text(json.dumps({"reading": reading}))


def toy_rests(path: str, reading: dict[str, Any], folder: Path) -> None:
    """What a motion rests on."""
    sys.stdout.write(json.dumps({"boxes": [{"kind": "seat", "size": [1, 1, 1], "pos": [0, 0, 0.5]}]}))
    sys.stdout.flush()
