"""Supports that a motion needs, found by inverse dynamics where floor and feet cannot bear it."""

# pyright: reportMissingTypeStubs=false, reportUnknownArgumentType=false, reportUnknownMemberType=false, reportUnknownVariableType=false
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from poise.body import BodyTable
from poise.kinematics.forward import centre_of_mass
from poise.kinematics.rate import SMOOTH_S
from poise.kinematics.repair.needs import AloneRules, NotAlone, beyond_a_floor
from poise.kinematics.supports import SAME_M, Candidate, Solid, Support, boxed, together
from poise.motion.rotations import GRAVITY
from poise.motion.smoothing import gaussian

#: Moments count as forces at this arm, m.
ARM_M = 0.5
#: Friction of what a body rests on; of a wall, which bears little weight.
FRICTION, OF_A_WALL = 0.8, 0.4


@dataclass(frozen=True, eq=False)
class RequiredWrench:
    """What a motion asks of the world.

    Newton and Euler about the centre of mass c of a body of mass M, its parts' masses m_i at x_i:

        f = M (c'' + g e_z),    tau = d/dt sum_i m_i (x_i - c) x (x_i' - c')

    Attributes:
        com: `(T, 3)` m, centre of mass, smoothed.
        force: `(T, 3)` N; torque: `(T, 3)` N m about it; world axes.
        weight: N.
    """

    com: np.ndarray
    force: np.ndarray
    torque: np.ndarray
    weight: float

    def missing(self, frame: int, points: np.ndarray, normals: np.ndarray) -> tuple[float, np.ndarray]:
        """What contacts cannot give in a frame, as a share of the weight; and their forces `(K, 3)` N.

        The least of |f - sum f_k| and |tau - sum (p_k - c) x f_k| / `ARM_M` over forces in their cones.

        points, normals: `(K, 3)` m and unit vectors toward the body, each the axis of a cone of four
        edges with `FRICTION`, or `OF_A_WALL`.
        """
        # It takes a while to import, and few motions need it.
        from scipy.optimize import nnls

        wanted = np.concatenate((self.force[frame], self.torque[frame] / ARM_M)) / self.weight
        if not len(points):
            return float(np.linalg.norm(wanted)), np.zeros((0, 3))
        edges = _edges(normals)
        arms = np.broadcast_to((points - self.com[frame])[:, None], edges.shape)
        columns = np.concatenate((edges, np.cross(arms, edges) / ARM_M), -1).reshape(-1, 6).T
        share, left = nnls(columns, wanted)
        forces = (share.reshape(-1, 4)[..., None] * edges).sum(1) * self.weight
        return float(left), forces


def asked(table: BodyTable, pos: np.ndarray, quat: np.ndarray, fps: float) -> RequiredWrench:
    """What a motion asks of the world; `pos`, `quat`: `(T, B, 3)` m and `(T, B, 4)`, places of its
    rows."""
    mass = np.array([r.mass for r in table.rows])
    com = _smooth(centre_of_mass(table, pos, quat), fps)
    parts = _smooth(pos.reshape(len(pos), -1), fps).reshape(pos.shape)
    rate = np.gradient(parts, axis=0) * fps
    speed = np.gradient(com, axis=0) * fps
    spin = (np.cross(parts - com[:, None], rate - speed[:, None]) * mass[:, None]).sum(1)
    acc = np.gradient(speed, axis=0) * fps
    force = mass.sum() * (acc + np.array([0.0, 0.0, GRAVITY]))
    return RequiredWrench(com, force, np.gradient(spin, axis=0) * fps, float(mass.sum() * GRAVITY))


def _edges(normals: np.ndarray) -> np.ndarray:
    """`(K, 4, 3)` edges of the cones about `normals (K, 3)`."""
    other = np.where(np.abs(normals[:, 2:]) > 0.9, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    a = np.cross(normals, other)
    a /= np.linalg.norm(a, axis=-1, keepdims=True)
    b = np.cross(normals, a)
    rough = np.where(np.abs(normals[:, 2:]) > 0.9, FRICTION, OF_A_WALL)[:, None]
    return normals[:, None] + rough * np.stack((a, b, -a, -b), 1)


def _smooth(path: np.ndarray, fps: float) -> np.ndarray:
    """A path `(T, n)` without jitter, see `balance_point`."""
    reach = min(math.ceil(4 * SMOOTH_S * fps), len(path) - 1)
    padded = np.pad(path, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
    kernel = gaussian(SMOOTH_S * fps, reach)
    return np.stack([np.convolve(x, kernel, "valid") for x in padded.T], -1)


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
    table: BodyTable, pos: np.ndarray, quat: np.ndarray, fps: float, rules: AloneRules | None = None
) -> tuple[Support, ...]:
    """What a motion, standing on z = 0, rests on besides its floor; in order of time.

    In the spells of `beyond_a_floor` that are held or lean, inverse dynamics tells which force and
    moment are missing (`RequiredWrench`). Still parts of the body are tried as what bears it, on a plane
    that is level or, for a wall, upright: that which leaves the least missing is taken, until all is
    borne. Each gets a box as large as the motion leaves room for. Spells of which more than 1 - `MOSTLY`
    stay unborne get nothing: a partner, a swing or water bore them.

    Args:
        table: the body. pos, quat: `(T, B, 3)` m and `(T, B, 4)` wxyz, places of its rows.
    """
    pos, quat = pos.astype(float), quat.astype(float)
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


def _borne(
    spell: tuple[int, int], solid: Solid, wanted: RequiredWrench
) -> list[tuple[Candidate, float]]:
    """What bears a spell, with the greatest force on each; nothing where it stays unborne."""
    first, last = spell
    frames = np.unique(np.round(np.linspace(first, last, min(FRAMES, last - first + 1))).astype(int))
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
    frames: np.ndarray, chosen: Sequence[Candidate], solid: Solid, wanted: RequiredWrench,
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
    frames: np.ndarray, chosen: Sequence[Candidate], which: int, solid: Solid, wanted: RequiredWrench
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
