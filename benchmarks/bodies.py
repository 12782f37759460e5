"""One policy on bodies of six sizes: its own, onto which motions are retargeted, and the clip's own.

    python benchmarks/bodies.py --data FOLDER --json benchmarks/bodies.json [--policy FILE --name NAME]

Each of the 16 clips of `zero_help.py` is scaled as a whole, bones and path, to people of 1.16 to 2.0 m.
The policy does it alone and without help, on the body that it was trained on ("policy") and on one with
the same bodies and hinges that has the lengths and masses of the clip ("own"). Success is from frame 0
to the end; errors are means over the frames before it was lost, in mm on the body that was simulated.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from speed import machine
from zero_help import CLIPS

from poise.body import generate_table
from poise.errors import PoiseError
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.track import TrackConfig, track
from poise.jobs.tracker import Tracker
from poise.learn.checkpoint import write_atomic
from poise.motion import Clip

HEIGHTS_M = (1.16, 1.33, 1.5, 1.67, 1.83, 2.0)


def sized(clip: Clip, height_m: float) -> Clip:
    """A clip of a person as tall as that, who does the same in the same time."""
    factor = height_m / generate_table(clip.skeleton, None, [clip]).height_m
    bones = replace(clip.skeleton, offsets=clip.skeleton.offsets * factor)
    return clip.replaced(skeleton=bones, root_pos=clip.root_pos * factor)


def row(clips: dict[str, Clip], height_m: float, body: str, tracker: Tracker) -> dict[str, object]:
    """What the policy does with all clips at one size."""
    whole, errors, problems = list[str](), list[float](), dict[str, str]()
    for name, clip in clips.items():
        try:
            config = TrackConfig(body=body, controller="policy", threads=1)  # type: ignore[arg-type]
            card = track(sized(clip, height_m), tracker, config).card
        except PoiseError as problem:
            problems[name] = str(problem)
            continue
        errors.append(card.mpjpe_global_mm)
        whole += [name] if card.tracked == 1.0 else []
    mean = round(float(np.mean(errors)), 1) if errors else None
    return {
        "whole": len(whole),
        "clips": len(clips),
        "error_mm": mean,
        "problems": problems,
        "of": whole,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--policy", default=None)
    parser.add_argument("--name", default="tracker")
    parser.add_argument("--json", type=Path, required=True)
    a = parser.parse_args()
    torch.set_num_threads(1)
    tracker, clips = open_run(a.policy).tracker, dict[str, Clip]()
    for name, (file, skeleton, fps, _) in CLIPS.items():
        path = a.data / file
        clips[name] = read_clip(path, skeleton=path.with_name(skeleton) if skeleton else None, fps=fps)
    said: dict[str, Any] = json.loads(a.json.read_text()) if a.json.exists() else {"rows": {}}
    said |= {"command": "benchmarks/bodies.py", "machine": machine()}
    for height in HEIGHTS_M:
        for body in ("policy", "own"):
            said["rows"][f"{a.name}/{body}/{height:g}"] = row(clips, height, body, tracker)
            write_atomic(a.json, (json.dumps(said, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
