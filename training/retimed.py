"""Walks and runs of a training library played faster and slower, as more clips of it.

    python training/retimed.py FOLDER -o FOLDER/retimed

Each take of walking, jogging or running is written once more as BVH, at a speed drawn between 0.88 and
1.3 of its own: people walk and run at more speeds than a small library holds.
"""

from __future__ import annotations

import argparse
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from poise.formats import read_clip, write_clip

#: Takes of walking, jogging and running by their names, without those walked backwards.
GAITS = re.compile(
    r"expmaps.*(walking|running)|amc/(02/02_0[123]|07/|35/|06/|08/)|_(walk|jog|run|long_walk\d)\.txt"
)
SLOWEST, FASTEST = 0.88, 1.3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    a = parser.parse_args()
    rng = np.random.default_rng(a.seed)
    a.out.mkdir(parents=True, exist_ok=True)
    files = sorted(p for p in a.folder.rglob("*") if GAITS.search(p.as_posix()) and p.suffix != ".asf")
    for path in files:
        if a.out in path.parents:
            continue
        speed = float(rng.uniform(SLOWEST, FASTEST))
        clip = read_clip(path)
        faster = replace(clip, fps=clip.fps * speed, name=f"{path.stem}-at-{speed:.2f}")
        write_clip(faster, a.out / f"{faster.name}.bvh")
        print(f"{path.relative_to(a.folder)}: {speed:.2f}")


if __name__ == "__main__":
    main()
