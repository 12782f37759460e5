"""A clip as the page shows it: places of its joints, faults, guesses, contacts, what it rests on."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np

from poise.formats import home_suffix
from poise.formats.text import write_whole
from poise.kinematics import anatomy_of, examine, find_guesses, support_of
from poise.kinematics.forward import carried
from poise.kinematics.repair.faults import KINDS
from poise.kinematics.repair.needs import not_alone
from poise.motion import Clip, find_roles, ground_shift
from poise.motion.clip_info import describe, standing_height
from poise.motion.smoothing import find_runs
from poise.settings import plain

#: Bytes of places that a page is sent at most; of longer motions it shows each second frame, or third.
MOST_BYTES = 96 << 20
#: Radius of a bone by the part that begins there, m, of a person of `TALL_M`.
RADII = {
    "hips": 0.1,
    "spine": 0.1,
    "neck": 0.05,
    "head": 0.085,
    "clavicle": 0.05,
    "upper_arm": 0.046,
    "forearm": 0.038,
    "hand": 0.032,
    "thigh": 0.072,
    "shin": 0.05,
    "foot": 0.04,
    "toes": 0.034,
}
TALL_M, FINGER_M, OTHER_M = 1.7, 0.011, 0.02


def figure_of(clip: Clip) -> bytes:
    """A clip to draw: the length of a header as four bytes, little-endian, the header as JSON, blanks up
    to a multiple of four, and places `(T, J, 3)` as float32, m, Z up, of joints and, after them, of bone
    tips."""
    skeleton, tips, pos = clip.skeleton, _tips(clip), places_of(clip)
    step = math.ceil(pos.size * 4 / MOST_BYTES)
    roles = {r.joint: r for r in find_roles(skeleton).rows}
    tall = min(max(standing_height(clip)[0] / TALL_M, 1e-3), 1e3)
    parents = [*skeleton.parents, *(j for j, _ in tips)]
    radii, sides = [], []
    for joint, parent in enumerate(parents):
        role = roles.get(parent)
        kind = "" if role is None else role.kind
        finger = FINGER_M if role is not None else OTHER_M
        # A hip belongs to the pelvis on its way to the thigh, and is no part of the trunk.
        radius = 0.06 if kind in ("hips", "spine") and _sided(roles, joint) else RADII.get(kind, finger)
        radii.append(round(radius * tall, 4))
        side = roles.get(joint) or role
        sides.append("" if side is None else side.side)
    head = next((r.joint for r in roles.values() if r.role == "head"), None)
    header = {
        "names": [*skeleton.names, *(f"{skeleton.names[j]} tip" for j, _ in tips)],
        "parents": parents,
        "joints": len(skeleton),
        "sides": sides,
        "radii": radii,
        "head": head,
        "head_m": round(0.105 * tall, 4),
        "roles": {r.role: joint for joint, r in roles.items()},
        "fps": clip.fps,
        "frames": clip.frames,
        "step": step,
        "seconds": clip.seconds,
        "home": home_suffix(clip),
        **{k: v for k, v in describe(clip).items() if k in ("format", "unit_m", "up_axis", "height_m")},
    }
    return headed(header) + pos[::step].astype("<f4").tobytes()


def headed(header: dict[str, Any]) -> bytes:
    """The header of what is drawn: see `figure_of`."""
    words = json.dumps(plain(header)).encode()
    words += b" " * (-len(words) % 4)
    return struct.pack("<I", len(words)) + words


def places_of(clip: Clip) -> np.ndarray:
    """Places `(T, J, 3)` m, Z up, of joints and, after them, of bone tips."""
    pos, quat = clip.world()
    tips = (carried(pos[:, j], quat[:, j], end)[:, None] for j, end in _tips(clip))
    return np.concatenate([pos, *tips], 1)


def _tips(clip: Clip) -> list[tuple[int, np.ndarray]]:
    return [(j, np.array(end)) for j, end in clip.skeleton.ends if np.linalg.norm(end) > 1e-6]


def _sided(roles: dict[int, Any], joint: int) -> bool:
    return joint in roles and bool(roles[joint].side)


def judged(clip: Clip) -> dict[str, Any]:
    """Faults as `poise doctor` finds them, spells that need more than a floor, guesses as `poise info`
    tells them, and contacts of the feet, in frames of the clip."""
    found = examine(clip)
    faults = [{**f.to_dict(), "title": KINDS[f.kind].title} for f in found.faults]
    support = support_of(clip, anatomy_of(clip))
    contacts: list[dict[str, Any]] = []
    if support is not None:
        touching = support.contacts[1]
        for foot in dict.fromkeys(support.feet):
            mine = np.any(touching[:, np.array(support.feet) == foot], axis=-1)
            contacts.append({"joint": foot, "runs": [[a, b + 1] for a, b in find_runs(mine, 1)]})
        level = ground_shift(clip, support.fit.lift_m)
        faults += [
            {
                "kind": "support missing",
                "joint": "",
                "start": n.start,
                "stop": n.stop,
                "size": n.size_m,
                "unit": "m",
                "detail": n.sentence(clip.fps),
                "repairable": False,
                "title": "rests on something that is not there",
            }
            for n in not_alone(level, support.table)
            if n.kind in ("held", "leaning")
        ]
    guesses = [g.to_dict() for g in find_guesses(clip)]
    told = " ".join(g["evidence"] for g in guesses)
    return plain(
        {
            "faults": faults,
            "figures": found.figures,
            "judged": found.judged,
            "in_place": None if found.travel is None else found.travel.words(),
            "guesses": guesses,
            "notes": [n for n in clip.skeleton.source.notes if n not in told],
            "contacts": contacts,
        }
    )


def write_look(clip: Clip, folder: Path) -> None:
    """Writes `figure.bin`, then `judged.json`, which takes longer, into a folder."""
    write_whole(folder / FIGURE, figure_of(clip))
    write_whole(folder / JUDGED, json.dumps(judged(clip)))


FIGURE, JUDGED = "figure.bin", "judged.json"


def rests_of(clip: Clip) -> list[dict[str, Any]]:
    """The boxes that a motion rests on, found as `poise track` does it before it simulates, in the world
    of the clip: see `kinematics.supports.Support`."""
    from poise.jobs.open import open_run
    from poise.jobs.track.surroundings import at_home
    from poise.jobs.track.tracking import FEATURES, TrackConfig, TrackSession

    session = TrackSession(open_run(None).tracker, TrackConfig(), [clip])
    for feature in FEATURES:
        if feature.asked(session):
            feature.prepare(session)
    return [s.to_dict() for s in at_home(session.supports, session.placed[0])]
