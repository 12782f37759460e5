"""How long `poise imitate` takes to show a motion without help, and to do it from everywhere.

    python benchmarks/imitate_clips.py --data FOLDER --json benchmarks/imitate_clips.json
        [--only NAME ...] [--minutes 10] [--seeds 0] [--threads 1]

For each clip, on the policy's joints with the bones of the clip, from reading the file on, without any
help: seconds until the first result, which looks ahead and searches for what is lost so, and whether it
is the whole motion; and seconds of the whole training, which ends where the policy alone succeeds from
32 start frames or at `--minutes`, with success over all start frames after it. A row that is there is
measured again for another policy alone.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
import time
from pathlib import Path

import torch
from speed import machine
from zero_help import CLIPS

from poise.errors import PoiseError
from poise.formats import read_clip
from poise.jobs.imitate import imitate
from poise.jobs.track import TrackConfig, track
from poise.jobs.tracker import SHIPPED
from poise.learn.checkpoint import write_atomic

#: File, skeleton and rate of each clip; `zero_help.py` has the same, but for the backflip.
FILES = {k: v[:3] for k, v in CLIPS.items()}
FILES["backflip"] = ("deepmimic_txt/humanoid3d_backflip.txt", None, None)


def measured(name: str, data: Path, minutes: float, seed: int, threads: int) -> dict[str, object]:
    """A clip's row."""
    file, skeleton, fps = FILES[name]
    began = time.perf_counter()
    of = (data / file).with_name(skeleton) if skeleton else None
    clip = read_clip(data / file, skeleton=of, fps=fps)
    config = TrackConfig(body="own", threads=threads, seed=seed)
    first = track(clip, config=config)
    seen = time.perf_counter() - began
    with tempfile.TemporaryDirectory() as folder:
        made = imitate(clip, minutes, folder=folder, threads=threads, seed=seed)
        card, total = made.card, time.perf_counter() - began
    return {
        "seconds": round(clip.seconds, 2), "first_whole": first.card.tracked == 1.0,
        "first_s": round(seen, 1), "first_mm": first.card.mpjpe_global_mm,
        "train_s": round(total - seen, 1),
        "succ": card.succ, "mpjpe_mm": card.mpjpe_mm, "threads": threads,
    }  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Measures clip by clip, and writes after each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=list(FILES), choices=list(FILES))
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args(argv)
    torch.set_num_threads(given.threads)
    policy = hashlib.sha256(SHIPPED.read_bytes()).hexdigest()[:16]
    said = json.loads(given.json.read_text()) if given.json.exists() else {"rows": {}}
    said |= {"command": "benchmarks/imitate_clips.py", "machine": machine(), "minutes": given.minutes}
    for name in given.only:
        for seed in given.seeds:
            key = f"{name}/{seed}"
            if said["rows"].get(key, {}).get("policy") == policy:
                continue
            try:
                row = measured(name, given.data, given.minutes, seed, given.threads)
            except PoiseError as problem:
                row = {"problem": str(problem)}
            said["rows"][key] = row | {"policy": policy}
            write_atomic(given.json, (json.dumps(said, indent=2) + "\n").encode())
            sys.stdout.write(f"{key}: {row}\n")
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
