"""Draws docs/dream.svg: a character that goes about, seen every second, one row for ten seconds.

    poise dream --seconds 60 --seed 1 -o dreamt
    python docs/make_dream_svg.py dreamt/simulated.bvh docs/dream.svg

Each figure is seen from the same side, moved to its place in the strip; the line is the floor.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from poise.formats import read_clip
from poise.motion import Clip

SCALE, WIDE, HIGH, ROW = 62.0, 86.0, 150.0, 10
#: Where the camera looks from: to the right and up in the picture, per metre of X, Y, Z.
RIGHT, UP = np.array([0.8, 0.6, 0.0]), np.array([-0.12, 0.16, 0.98])
COLOURS = {"l": "#3b6fb6", "r": "#dd7722", "": "#444444"}


def side(name: str) -> str:
    """ "l" or "r" of a joint of a limb, else ""."""
    return name[0].lower() if name[:4].lower() == "left" or name[:5].lower() == "right" or (
        len(name) > 1 and name[0] in "lr" and name[1:] in LIMBS) else ""  # fmt: skip


LIMBS = ("femur", "tibia", "foot", "toes", "clavicle", "humerus", "radius", "wrist", "hand", "hipjoint")


def figure(clip: Clip, frame: int, x: float, y: float) -> str:
    """One pose with the middle of its floor at `x`, `y` in the picture."""
    pos = clip.positions()[frame].copy()
    pos[:, :2] -= pos[0, :2]
    flat = np.stack([pos @ RIGHT, -(pos @ UP)], -1) * SCALE + [x, y]
    lines: list[str] = []
    for j, parent in enumerate(clip.skeleton.parents):
        if parent >= 0:
            (a, b), (c, d) = flat[parent], flat[j]
            colour = COLOURS[side(clip.skeleton.names[j])]
            lines.append(f'<path stroke="{colour}" d="M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}"/>')
    head = next((j for j, n in enumerate(clip.skeleton.names) if n.lower() == "head"), 0)
    cx, cy = flat[head]
    return "".join(lines) + f'<circle cx="{cx:.1f}" cy="{cy:.1f}" r="7" fill="#444444"/>'


def main(motion: Path, out: Path) -> None:
    """Reads, draws, writes."""
    clip = read_clip(motion)
    picks = range(0, clip.frames, round(clip.fps))
    rows = -(-len(picks) // ROW)
    size = f"{WIDE * ROW:.0f} {HIGH * rows:.0f}"
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size}" font-family="sans-serif">']
    parts.append(f'<rect width="{WIDE * ROW:.0f}" height="{HIGH * rows:.0f}" fill="#fafafa"/>')
    parts.append('<g fill="none" stroke-width="6" stroke-linecap="round">')
    for k, frame in enumerate(picks):
        x, y = WIDE * (k % ROW + 0.5), HIGH * (k // ROW + 1) - 26
        if k % ROW == 0:
            parts.append(f'<path stroke="#cccccc" stroke-width="1" d="M0 {y}H{WIDE * ROW:.0f}"/>')
        parts.append(figure(clip, frame, x, y))
        parts.append(f'<text x="{x - 8}" y="{y + 18}" fill="#777777" font-size="11">{k} s</text>')
    out.write_text("\n".join([*parts, "</g></svg>"]) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
