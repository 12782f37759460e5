"""Which supports a motion needs: where floor and feet cannot bear it, what can, and how large it is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from poise.body import BodyTable
from poise.kin.doctor.alone import AloneRules, NotAlone, beyond_a_floor
from poise.kin.supports.candidates import Candidate, Solid
from poise.kin.supports.shape import SAME_M, boxed, together
from poise.kin.supports.support import Support
from poise.kin.supports.wrench import Asked, asked

#: Nearer to its edge than a library's rules have it: what is found must explain the spell besides.
RULES = AloneRules(margin_m=0.08)
#: A frame is borne where no more than this share of the weight is missing.
BORNE = 0.06
#: Where more than this is missing in more than 1 - `MOSTLY` of a spell, something else bore it.
UNBORNE = 0.15
#: What a support must bring, in shares of the weight times seconds, and in how much of a spell.
LEAST_GAIN_S, MOSTLY = 0.1, 0.6
#: Frames of a spell that are looked at, and supports that it may have.
FRAMES, MOST = 80, 8
#: Parts farther from each other than this do not share one, m.
BESIDE_M = 0.6


def find_supports(
    table: BodyTable, pos: Tensor, quat: Tensor, fps: float, rules: AloneRules | None = None
) -> tuple[Support, ...]:
    """What a motion, standing on z = 0, rests on besides its floor; in order of time.

    In the spells of `beyond_a_floor` that are held or lean, inverse dynamics tells which force and
    moment are missing (`wrench`). Still parts of the body are tried as what bears it, on a plane that is
    level or, for a wall, upright: that which leaves the least missing is taken, until all is borne. Each
    gets a box as large as the motion leaves room for. Spells of which more than 1 - `MOSTLY` stay
    unborne get nothing: a partner, a swing or water bore them.

    Args:
        table: the body. pos, quat: `(T, B, 3)` m and `(T, B, 4)` wxyz, places of its rows.
    """
    pos, quat = pos.double(), quat.double()
    spells = beyond_a_floor(table, pos, quat, fps, rules or RULES)
    spells = [s for s in spells if s.kind != "below"]
    if not spells:
        return ()
    solid, wanted = Solid(table, pos, quat, fps), asked(table, pos, quat, fps)
    found: list[tuple[Candidate, float]] = []
    for spell in _joined(spells, len(pos)):
        found += _borne(spell, solid, wanted)
    if found:
        found = _with_all_that_rests(found, solid)
    supports = [boxed(group, solid) for group in together(found)]
    return tuple(sorted((s for s in supports if s is not None), key=lambda s: s.start_s))


def _joined(spells: Sequence[NotAlone], frames: int) -> list[tuple[int, int]]:
    """Spells with what leads there and away, as frames; those that meet are one."""
    ends = sorted((max(0, s.start - s.lead), min(frames - 1, s.stop + s.trail)) for s in spells)
    out = [ends[0]]
    for a, b in ends[1:]:
        if a <= out[-1][1] + 1:
            out[-1] = out[-1][0], max(b, out[-1][1])
        else:
            out.append((a, b))
    return out


def _borne(spell: tuple[int, int], solid: Solid, wanted: Asked) -> list[tuple[Candidate, float]]:
    """What bears a spell, with the greatest force on each; nothing where it stays unborne."""
    first, last = spell
    frames = np.unique(np.linspace(first, last, min(FRAMES, last - first + 1)).round().astype(int))
    dt = (last - first + 1) / solid.fps / len(frames)
    tried, chosen = solid.candidates(first, last), list[Candidate]()
    left = _missing(frames, chosen, solid, wanted)
    while tried and len(chosen) < MOST and (left > BORNE).any():
        gains = [
            (left - np.minimum(left, _missing(frames, [*chosen, c], solid, wanted, left))) for c in tried
        ]
        sums = [c.group.bias * float(g.sum()) * dt for c, g in zip(tried, gains, strict=True)]
        best = int(np.argmax(sums))
        if sums[best] < LEAST_GAIN_S:
            break
        taken = tried.pop(best)
        if boxed([(taken, 0.0)], solid) is None:
            continue
        left = left - gains[best]
        chosen.append(taken)
    if (left <= UNBORNE).mean() < MOSTLY:
        return []
    return [(c, _force(frames, chosen, k, solid, wanted)) for k, c in enumerate(chosen)]


def _contacts(
    frame: int, chosen: Sequence[Candidate], solid: Solid
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals, and which of `chosen` each is of, -1 for the floor."""
    floor = solid.floor(frame)
    points, normals, of = [floor], [np.tile([0.0, 0.0, 1.0], (len(floor), 1))], [-np.ones(len(floor))]
    for k, c in enumerate(chosen):
        mine = solid.touching(c, frame)
        points.append(mine)
        normals.append(np.tile(c.normal, (len(mine), 1)))
        of.append(np.full(len(mine), k))
    return np.concatenate(points), np.concatenate(normals), np.concatenate(of)


def _missing(
    frames: np.ndarray, chosen: Sequence[Candidate], solid: Solid, wanted: Asked,
    before: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """What is missing in each frame; that of `before` where the last of `chosen` changes nothing."""
    out = np.zeros(len(frames)) if before is None else before.copy()
    for i, frame in enumerate(frames):
        if before is not None and (
            before[i] <= BORNE or not chosen[-1].start <= frame <= chosen[-1].stop
        ):
            continue
        points, normals, _ = _contacts(int(frame), chosen, solid)
        out[i] = wanted.missing(int(frame), points, normals)[0]
    return out


def _force(
    frames: np.ndarray, chosen: Sequence[Candidate], which: int, solid: Solid, wanted: Asked
) -> float:
    """The greatest force on one of them, N."""
    most = 0.0
    for frame in frames:
        points, normals, of = _contacts(int(frame), chosen, solid)
        forces = wanted.missing(int(frame), points, normals)[1][of == which]
        most = max(most, float(np.linalg.norm(forces.sum(0))))
    return most


def _with_all_that_rests(
    found: Sequence[tuple[Candidate, float]], solid: Solid
) -> list[tuple[Candidate, float]]:
    """With what rests on the same planes near by without being needed for it, such as a second foot."""
    out = list(found)
    for c in solid.candidates(0, len(solid.pos) - 1):
        for o, _ in found:
            same = o.group.kind == c.group.kind and float(o.normal @ c.normal) > 0.9
            apart = solid.pos[c.start, c.group.rows[0]] - solid.pos[o.start, o.group.rows[0]]
            if same and abs(o.level - c.level) < SAME_M and np.linalg.norm(apart) < BESIDE_M:
                out.append((c, 0.0))
                break
    return out
