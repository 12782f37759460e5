"""Draws docs/walk.svg: the embedded walk and its simulation by the policy that comes with Poise.

    poise track src/poise/data/walk.bvh -o walk_simulated.bvh --no-hold-feet
    python docs/make_walk_svg.py src/poise/data/walk.bvh walk_simulated.bvh docs/walk.svg

An animated SVG without scripts: each group of bones is one path whose outline changes with time. Both
clips have the same skeleton and rate; the camera is fixed and parallel lines stay parallel.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np

from poise.formats import read_clip
from poise.motion import Clip

SIZE = (860, 380)
SCALE = 158.0  # pixels in a metre
BASE = SIZE[1] - 62.0  # height of the middle of the floor in the picture
EVERY = 2  # frames of the clip for one of the picture
AZIMUTH, ELEVATION = math.radians(19.0), math.radians(13.0)
LANE = 0.8  # metres to either side of the middle line
#: Groups in the order in which they are drawn: far limbs, trunk, near limbs; width in metres.
GROUPS = (("Left", 0.085, 0.72), ("", 0.15, 0.9), ("Right", 0.095, 1.0))
COLOURS = {"clip": (59, 111, 182), "simulation": (221, 119, 34)}


def camera(clip: Clip) -> tuple[np.ndarray, np.ndarray]:
    """Two `(3,)` vectors, to the right and up in the picture, for a clip that walks to the right."""
    way = clip.root_pos[-1] - clip.root_pos[0]
    turn = math.atan2(way[1], way[0]) - AZIMUTH
    right = np.array([math.cos(turn), math.sin(turn), 0.0])
    away = np.array([-math.sin(turn), math.cos(turn), 0.0])
    up = np.array([0.0, 0.0, math.cos(ELEVATION)]) + away * math.sin(ELEVATION)
    return right, up


def bones(clip: Clip, side: str) -> list[tuple[int, int]]:
    """The joints at both ends of each bone of one side; "" is the trunk with neck and head."""
    names, parents = clip.skeleton.names, clip.skeleton.parents
    limb = [
        next((s for s in ("Left", "Right") if n.startswith(s) and "Shoulder" not in n), "")
        for n in names
    ]
    # The first bone of a leg lies in the pelvis.
    trunk = [s == "" or n.endswith("UpLeg") for s, n in zip(limb, names, strict=True)]
    own = [t if side == "" else s == side and not t for t, s in zip(trunk, limb, strict=True)]
    return [(int(parents[j]), j) for j in range(1, len(names)) if own[j]]


def outline(flat: np.ndarray, pairs: list[tuple[int, int]]) -> str:
    """The path of one frame; `flat (J, 2)` in pixels."""
    return "".join("M{:.0f} {:.0f}L{:.0f} {:.0f}".format(*flat[a], *flat[b]) for a, b in pairs)


def figure(clip: Clip, lane: float, kind: str, middle: np.ndarray) -> str:
    """The elements of one character, `lane` metres beyond the middle line."""
    right, up = camera(clip)
    side = np.cross([0.0, 0.0, 1.0], clip.root_pos[-1] - clip.root_pos[0])
    places = clip.positions()[::EVERY] - middle + lane * side / np.linalg.norm(side)
    flat = np.stack([places @ right, -(places @ up)], -1) * SCALE + [SIZE[0] / 2, BASE]
    seconds = len(flat) * EVERY / clip.fps
    parts = [shadow(places, right, up, seconds)]
    for name, width, light in GROUPS:
        frames = [outline(f, bones(clip, name)) for f in flat]
        colour = "#{:02x}{:02x}{:02x}".format(*(int(c * light) for c in COLOURS[kind]))
        stroke = f'stroke="{colour}" stroke-width="{width * SCALE:.0f}"'
        parts.append(
            f'<path {stroke} d="{frames[len(frames) // 2]}">{animate("d", frames, seconds)}</path>'
        )
        if name == "":
            head = clip.skeleton.names.index("Head")
            crown = flat[:, head] + [2, -0.1 * SCALE]
            x, y = ([f"{v:.0f}" for v in crown[:, i]] for i in (0, 1))
            k = len(x) // 2
            move = animate("cx", x, seconds) + animate("cy", y, seconds)
            at = f'cx="{x[k]}" cy="{y[k]}"'
            parts.append(f'<circle r="{0.105 * SCALE:.0f}" fill="{colour}" {at}>{move}</circle>')
    return "\n".join(parts)


def shadow(places: np.ndarray, right: np.ndarray, up: np.ndarray, seconds: float) -> str:
    """An ellipse on the floor under the root."""
    floor = places[:, 0] * [1.0, 1.0, 0.0]
    x = [f"{v:.0f}" for v in floor @ right * SCALE + SIZE[0] / 2]
    y = [f"{v:.0f}" for v in -(floor @ up) * SCALE + BASE]
    k = len(x) // 2
    move = animate("cx", x, seconds) + animate("cy", y, seconds)
    return f'<ellipse rx="48" ry="11" fill="#0002" cx="{x[k]}" cy="{y[k]}">{move}</ellipse>'


def animate(name: str, values: list[str], seconds: float) -> str:
    """The values of an attribute over time, again and again."""
    listed = ";".join(values)
    often = f'dur="{seconds:.2f}s" repeatCount="indefinite"'
    return f'<animate attributeName="{name}" {often} values="{listed}"/>'


def main(clip: Path, simulated: Path, out: Path) -> None:
    """Writes the picture."""
    shown = read_clip(clip), read_clip(simulated)
    middle = (shown[0].root_pos[0] + shown[0].root_pos[-1]) / 2 * [1.0, 1.0, 0.0]
    text = "".join(
        f'<text x="{24 + 190 * i}" y="34" fill="rgb{COLOURS[kind]}">{says}</text>'
        for i, (kind, says) in enumerate((("clip", "the clip"), ("simulation", "its simulation")))
    )
    figures = "\n".join(
        figure(c, lane, kind, middle)
        for c, lane, kind in zip(shown, (LANE, -LANE), ("clip", "simulation"), strict=True)
    )
    out.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {SIZE[0]} {SIZE[1]}">'
        "<title>A walk, and the same walk as a simulated character does it</title>\n"
        f'<rect width="{SIZE[0]}" height="{SIZE[1]}" rx="8" fill="#f6f4f0"/>\n'
        f'<g font-family="sans-serif" font-size="18">{text}</g>\n'
        f'<g fill="none" stroke-linecap="round" stroke-linejoin="round">\n{figures}\n</g>\n</svg>\n',
        encoding="utf-8",
    )


if __name__ == "__main__":
    main(*(Path(p) for p in sys.argv[1:4]))
