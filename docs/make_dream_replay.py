"""Draws docs/dream-replay.svg: a character that goes about, as a picture that moves.

    poise dream --seconds 60 --seed 1 -o dreamt
    python docs/make_dream_replay.py dreamt/simulated.bvh docs/dream-replay.svg

The camera goes along with the character and looks in one direction; dashes on the floor stand still,
one each metre, so that a foot that slides is seen against them. Ten pictures a second, between which
browsers go in straight lines.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from make_dream_svg import COLOURS, RIGHT, UP, side

from poise.formats import read_clip

RATE, SCALE, WIDE, HIGH, NEAR, SMOOTH = 10, 110.0, 640, 320, 2, 45


def smoothed(path: np.ndarray) -> np.ndarray:
    """Where the camera is: the root's way, mean over three seconds."""
    padded = np.pad(path, ((SMOOTH, SMOOTH), (0, 0)), "edge")
    kernel = np.ones(2 * SMOOTH + 1) / (2 * SMOOTH + 1)
    return np.stack([np.convolve(padded[:, k], kernel, "valid") for k in range(path.shape[1])], 1)


def moving(values: list[str], seconds: float, look: str) -> str:
    """A path that goes through `values`."""
    times = f'dur="{seconds:g}s" repeatCount="indefinite"'
    text = ";".join(values)
    return f'<path {look} d="{values[0]}"><animate attributeName="d" {times} values="{text}"/></path>'


def main(motion: Path, out: Path) -> None:
    """Reads, draws, writes."""
    clip = read_clip(motion)
    pos, step = clip.positions(), max(1, round(clip.fps / RATE))
    camera = np.concatenate((smoothed(pos[:, 0, :2]), np.zeros((len(pos), 1))), 1)
    bones = [(p, j) for j, p in enumerate(clip.skeleton.parents) if p >= 0]
    sides = {k: [b for b in bones if side(clip.skeleton.names[b[1]]) == k] for k in ("r", "", "l")}
    head = next((j for j, n in enumerate(clip.skeleton.names) if n.lower() == "head"), 0)
    drawn: dict[str, list[str]] = {"floor": [], "head": [], **{k: [] for k in sides}}
    for f in range(0, clip.frames, step):

        def flat(points: np.ndarray, at: np.ndarray = camera[f]) -> np.ndarray:
            off = points - at
            return np.stack([off @ RIGHT, -(off @ UP)], -1) * SCALE + [WIDE / 2, HIGH - 70]

        here = np.round(camera[f, :2])
        grid = [(here[0] + i, here[1] + j, 0.0) for i in range(-NEAR, NEAR + 1)
                for j in range(-NEAR, NEAR + 1)]  # fmt: skip
        # A dash that comes into sight takes the place of one that left, so paths keep their form.
        grid.sort(key=lambda p: (p[0] % (2 * NEAR + 1), p[1] % (2 * NEAR + 1)))
        drawn["floor"].append("".join(f"M{x - 3:.0f} {y:.0f}h6" for x, y in flat(np.array(grid))))
        at = flat(pos[f])
        for name, lines in sides.items():
            drawn[name].append("".join(
                f"M{at[a][0]:.0f} {at[a][1]:.0f}L{at[b][0]:.0f} {at[b][1]:.0f}" for a, b in lines
            ))  # fmt: skip
        drawn["head"].append(f"M{at[head][0]:.0f} {at[head][1]:.0f}h.1")
    seconds = (len(drawn["head"]) - 1) * step / clip.fps
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDE} {HIGH}">',
        f'<rect width="{WIDE}" height="{HIGH}" fill="#fafafa"/>',
        '<g fill="none" stroke-width="9" stroke-linecap="round">',
        moving(drawn["floor"], seconds, 'stroke="#bbbbbb" stroke-width="2"'),
        *(moving(drawn[k], seconds, f'stroke="{COLOURS[k]}"') for k in sides),
        moving(drawn["head"], seconds, 'stroke="#444444" stroke-width="24"'),
        "</g></svg>",
    ]
    out.write_text("\n".join(parts) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
