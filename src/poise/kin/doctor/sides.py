"""Left and right: what the names say against what the body's own shape says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from poise.body import Anatomy
from poise.motion import Clip
from poise.motion.info import sampled
from poise.motion.role_words import name_words, without_rig
from poise.spatial import quat_rotate

#: Share of frames by which the votes of the geometry must agree before they contradict the names.
SURE = 0.5
_PAIRS = ("thigh", "upper_arm")


def side_votes(clip: Clip, anatomy: Anatomy) -> dict[str, float]:
    """What tells the body's left, each from -1 (the names are exchanged) to 1 (they are right).

    With `up` from pelvis to chest and `forward`, left is up x forward. Forward is where the feet point
    ("feet"), where the bent knees point ("knees"), and where the walk leads ("travel"); the hips and
    shoulders named left should lie on that side of those named right. Sources that tell nothing (no
    toes, straight legs, standing) are left out.
    """
    at = sampled(clip.frames, 200)
    part = clip.replaced(root_pos=clip.root_pos[at], rot=clip.rot[at]) if len(at) > 1 else clip
    pos = part.positions()
    chest = anatomy.of("spine") or anatomy.of("neck") or anatomy.of("head")
    if not anatomy.parts or not chest:
        return {}
    up = _unit(pos[:, chest[-1]] - pos[:, anatomy.of("pelvis")[0]])
    across = np.zeros_like(up)
    for kind in _PAIRS:
        left, right = anatomy.of(kind, "left"), anatomy.of(kind, "right")
        if left and right:
            across += _unit(pos[:, left[0]] - pos[:, right[0]])
    out = {}
    for name, forward in _forwards(clip, anatomy, part, pos, up).items():
        left_w = np.cross(up, forward)
        told = np.linalg.norm(left_w, axis=-1) > 1e-9
        if told.any():
            out[name] = float(np.sign((left_w * across).sum(-1))[told].mean())
    return out


def exchanged_sides(clip: Clip, anatomy: Anatomy) -> bool:
    """Whether the joints named left lie on the body's right: exchanged names or mirrored axes.

    Feet and knees must agree, as far as they tell anything; travel alone proves nothing, since people
    also walk backwards.
    """
    votes = side_votes(clip, anatomy)
    told = [votes[k] for k in ("feet", "knees") if k in votes]
    return bool(told) and max(told) < -SURE


def swap_sides(clip: Clip) -> Clip:
    """The clip with the names of left and right joints exchanged; joints without a twin keep theirs."""
    names = clip.skeleton.names
    words = [name_words(n) for n in without_rig(names)]
    keys = [(w.side, w.tokens, w.number) for w in words]
    twin = {"left": "right", "right": "left"}
    out = list(names)
    for j, (side, tokens, number) in enumerate(keys):
        other = (twin.get(side, ""), tokens, number)
        if side and keys.count(other) == 1 and keys.count(keys[j]) == 1:
            out[j] = names[keys.index(other)]
    note = "The names of left and right joints were exchanged, as stated with --swap-sides"
    skeleton = replace(clip.skeleton, names=tuple(out))
    notes = (*skeleton.source.notes, note)
    travel = skeleton.source.travel_joint
    moved = out[names.index(travel)] if travel in names else travel
    return clip.replaced(skeleton=skeleton.with_source(notes=notes, travel_joint=moved))


def _forwards(
    clip: Clip, anatomy: Anatomy, part: Clip, pos: np.ndarray, up: np.ndarray
) -> dict[str, np.ndarray]:
    """World directions `(S, 3)` in which the body may face, zero where a frame tells nothing."""
    feet, shins, thighs = (anatomy.of(k) for k in ("foot", "shin", "thigh"))
    out: dict[str, np.ndarray] = {}
    toes = [j for _, j in anatomy.toes]
    tips = dict(clip.skeleton.ends)
    way = np.zeros_like(up)
    quat = part.world()[1]
    for foot in feet:
        toe = next((t for t in toes if clip.skeleton.parents[t] == foot), None)
        if toe is not None:
            way += _across(pos[:, toe] - pos[:, foot], up)
        elif foot in tips:
            way += _across(_world(quat[:, foot], tips[foot]), up)
    if np.linalg.norm(way, axis=-1).max() > 0.01:
        out["feet"] = way
    bend = np.zeros_like(up)
    for thigh, shin, foot in zip(thighs, shins, feet, strict=True):
        line = _unit(pos[:, foot] - pos[:, thigh])
        knee = pos[:, shin] - pos[:, thigh]
        knee = knee - (knee * line).sum(-1, keepdims=True) * line
        # A knee tells the front only where it is bent by more than some 20 degrees.
        length = np.linalg.norm(pos[:, foot] - pos[:, shin], axis=-1, keepdims=True)
        bend += np.where(np.linalg.norm(knee, axis=-1, keepdims=True) > 0.09 * length, knee, 0.0)
    if np.linalg.norm(bend, axis=-1).max() > 0.0:
        out["knees"] = bend
    walk = np.gradient(pos[:, anatomy.of("pelvis")[0]], axis=0)
    walk[:, 2] = 0.0
    if np.linalg.norm(pos[-1, 0, :2] - pos[0, 0, :2]) > 1.0:
        out["travel"] = walk
    return out


def _world(quat: np.ndarray, tip: tuple[float, float, float]) -> np.ndarray:
    """`(S, 3)` m, a joint's own vector `tip` in the world."""
    turns = torch.tensor(quat)
    return quat_rotate(turns, torch.tensor(tip, dtype=turns.dtype).expand(len(turns), 3)).numpy()


def _across(v: np.ndarray, up: np.ndarray) -> np.ndarray:
    return v - (v * up).sum(-1, keepdims=True) * up


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)
