"""Joint centres from surface markers: Plug-in Gait, the CMU set and OpenCap's augmented markers.

Understood are, with L or R before them: ASI and PSI (or FWT and BWT, or a middle SACR), KNE with a
medial KNM or MKN, ANK with a medial ANM or MMA, HEE, TOE, MT1 and MT5, SHO, ELB with a medial ELM, WRA
and WRB, FIN, FHD and BHD; in the middle C7, CLAV, STRN and T10; OpenCap's names end in "_study". Other
markers (thigh and shank wands, offsets) are left out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from poise.motion.points.labels import SIDES, split_label

Tracks = dict[str, np.ndarray]
Estimate = tuple[Tracks, str]
"""Tracks of some places, and the sentence that tells how they were estimated."""

# Half the width of a joint and a marker's radius, as shares of the standing height (Winter 2009; the
# shoulder's centre lies 17 % of the distance of the acromia below them, Rab et al. 2002).
_KNEE, _ANKLE, _ELBOW, _SHOULDER = 0.030, 0.021, 0.022, 0.17
_SHIN_SHARE = 0.246
_STRAIGHT = 0.3
# The lumbar point that shows the pelvis' tilt, along the line from hips to shoulders.
_LUMBAR = 0.18


def marker_places(
    names: Sequence[str], positions: np.ndarray, known: Tracks
) -> tuple[Tracks, list[str]]:
    """Tracks `(T, 3)` of the places that surface markers tell (NaN where missing), and notes.

    positions: `(T, K, 3)` m, Z up. known: places that are named outright, which stay as they are.
    """
    m = _Markers(names, positions)
    out: Tracks = {}
    notes: list[str] = []
    for side in SIDES:
        _put(out, f"{side}_heel", m.first(side, "hee", "calcstudy"))
        toe = m.first(side, "toestudy")
        _put(out, f"{side}_toe", m.middle(side, ("mt1",), ("mt5",)) if toe is None else toe)
        _put(out, f"{side}_wrist", m.middle(side, ("wra", "lwriststudy"), ("wrb", "mwriststudy")))
        _put(out, f"{side}_hand", m.first(side, "fin"))
    for estimate in (_shoulders, _legs, _elbows, _hips, _head_and_trunk, _lumbar):
        made, note = estimate(m, {**out, **known})
        out.update(made)
        if note and not set(made) <= set(known):
            notes.append(note)
    return out, notes


class _Markers:
    """Tracks by side and bare label."""

    def __init__(self, names: Sequence[str], positions: np.ndarray):
        self.at: dict[tuple[str, str], np.ndarray] = {}
        for k in reversed(range(len(names))):
            self.at[split_label(names[k])] = positions[:, k]

    def first(self, side: str, *cores: str) -> np.ndarray | None:
        """The first of these markers that there is."""
        return next((self.at[side, c] for c in cores if (side, c) in self.at), None)

    def middle(self, side: str, one: tuple[str, ...], other: tuple[str, ...]) -> np.ndarray | None:
        """The middle of two markers, None where either is not there."""
        a, b = self.first(side, *one), self.first(side, *other)
        return None if a is None or b is None else (a + b) / 2


def _put(out: Tracks, place: str, track: np.ndarray | None) -> None:
    if track is not None:
        out[place] = track


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)


def _shoulders(m: _Markers, have: Tracks) -> Estimate:
    """The joint lies below the acromion, along the trunk."""
    left, right = (m.first(s, "sho", "shoulderstudy") for s in SIDES)
    pelvis = _pelvis(m)
    if left is None or right is None or pelvis is None:
        return {}, ""
    width = np.nanmedian(np.linalg.norm(left - right, axis=-1))
    down = _unit(np.mean(list(pelvis.values()), axis=0) - (left + right) / 2)
    shift = _SHOULDER * width * down
    note = f"Shoulder joints taken {_SHOULDER * width * 1e3:.0f} mm below the shoulder markers"
    return {"left_shoulder": left + shift, "right_shoulder": right + shift}, note


def _legs(m: _Markers, have: Tracks) -> Estimate:
    """Knees and ankles: between two markers of the joint, else inwards from the outer one."""
    out: Tracks = {}
    single = []
    for side in SIDES:
        knee = m.middle(side, ("kne", "kneestudy"), ("knm", "mkn", "knem", "mkne", "mkneestudy"))
        medial = ("anm", "mank", "ankm", "mma", "med", "manklestudy")
        ankle = m.middle(side, ("ank", "anklestudy"), medial)
        outer = {"knee": m.first(side, "kne", "kneestudy"), "ankle": m.first(side, "ank", "anklestudy")}
        k = outer["knee"] if knee is None else knee
        a = outer["ankle"] if ankle is None else ankle
        if k is None or a is None:
            continue
        height = np.nanmedian(np.linalg.norm(k - a, axis=-1)) / _SHIN_SHARE
        inwards = _inwards(side, k, a, have)
        if knee is None and inwards is not None:
            knee = k + _KNEE * height * inwards
            single.append(f"{side} knee")
        if ankle is None and inwards is not None:
            ankle = a + _ANKLE * height * inwards
            single.append(f"{side} ankle")
        _put(out, f"{side}_knee", k if knee is None else knee)
        _put(out, f"{side}_ankle", a if ankle is None else ankle)
    note = (
        f"Only outer markers show the {', '.join(single)}: the joints were put inwards by the half "
        "width that is usual at this height (some millimetres wrong)"
    )
    return out, note if single else ""


def _inwards(side: str, knee: np.ndarray, ankle: np.ndarray, have: Tracks) -> np.ndarray | None:
    """From the outer side of a leg to the inner one, square to shin and foot."""
    front = have.get(f"{side}_toe")
    if front is None:
        front = have.get(f"{side}_toe_tip")
    if front is None:
        return None
    # Up x forward is left: inwards for the right leg.
    left = _unit(np.cross(knee - ankle, front - have.get(f"{side}_heel", ankle)))
    return -left if side == "left" else left


def _elbows(m: _Markers, have: Tracks) -> Estimate:
    """Between two markers of the elbow, else inwards along the axis about which it bends."""
    out: Tracks = {}
    single = []
    for side in SIDES:
        middle = m.middle(side, ("elb", "lelbowstudy"), ("elm", "melb", "elbm", "melbowstudy"))
        outer = m.first(side, "elb")
        shoulder, wrist = have.get(f"{side}_shoulder"), have.get(f"{side}_wrist")
        if middle is not None:
            out[f"{side}_elbow"] = middle
        elif outer is not None and shoulder is not None and wrist is not None:
            upper, lower = outer - shoulder, wrist - outer
            # The flexion axis points inwards at the left elbow and outwards at the right one.
            axis = np.cross(_unit(upper), _unit(lower))
            sine = np.linalg.norm(axis, axis=-1, keepdims=True)
            shift = _unit(axis) * np.minimum(sine / _STRAIGHT, 1.0)
            height = _height(have)
            out[f"{side}_elbow"] = outer + (1 if side == "left" else -1) * _ELBOW * height * shift
            single.append(f"{side} elbow")
    note = f"Only outer markers show the {', '.join(single)}: put inwards by {_ELBOW * 100:.1f} % "
    note += "of the height"
    return out, note if single else ""


def _height(have: Tracks) -> float:
    """Standing height in metres from the shins, 1.7 where they are not known."""
    pairs = [(have.get(f"{s}_knee"), have.get(f"{s}_ankle")) for s in SIDES]
    found = [float(np.nanmedian(np.linalg.norm(k - a, axis=-1))) for k, a in pairs
             if k is not None and a is not None]  # fmt: skip
    return float(np.mean(found)) / _SHIN_SHARE if found else 1.7


def _pelvis(m: _Markers) -> Tracks | None:
    """Left and right front, and the middle of the back of the pelvis, None where they are not marked."""
    left, right = (m.first(s, "asi", "asis", "asisstudy", "fwt") for s in SIDES)
    backs = [m.first(s, "psi", "psis", "psisstudy", "bwt") for s in SIDES]
    back = m.first("", "sacr", "sacrum")
    if back is None and backs[0] is not None and backs[1] is not None:
        back = (backs[0] + backs[1]) / 2
    if left is None or right is None or back is None:
        return None
    return {"left": left, "right": right, "back": back}


def _axes(pelvis: Tracks) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors `(T, 3)` to the left, forward and up of the plane through the pelvis' markers."""
    left = _unit(pelvis["left"] - pelvis["right"])
    ahead = (pelvis["left"] + pelvis["right"]) / 2 - pelvis["back"]
    up = _unit(np.cross(ahead, left))
    return left, np.cross(left, up), up


def _hips(m: _Markers, have: Tracks) -> Estimate:
    """Hip joint centres by the regression of Harrington et al. 2007 on the pelvis' markers."""
    out: Tracks = {}
    for side in SIDES:
        _put(out, f"{side}_hip", m.first(side, "hjcstudy"))
    pelvis = _pelvis(m)
    if pelvis is None or len(out) == len(SIDES):
        return out, ""
    left, ahead, up = _axes(pelvis)
    front = (pelvis["left"] + pelvis["right"]) / 2
    width = np.nanmedian(np.linalg.norm(pelvis["left"] - pelvis["right"], axis=-1))
    depth = np.nanmedian(np.linalg.norm(front - pelvis["back"], axis=-1))
    # x = -0.24 PD - 9.9 mm ahead, y = -0.30 PW - 10.9 mm up, z = 0.33 PW + 7.3 mm outwards
    for side, sign in (("left", 1.0), ("right", -1.0)):
        out[f"{side}_hip"] = (
            front
            - (0.24 * depth + 0.0099) * ahead
            - (0.30 * width + 0.0109) * up
            + sign * (0.33 * width + 0.0073) * left
        )
    note = (
        f"Hip joints estimated from the pelvis' markers (width {width * 1e3:.0f} mm, depth "
        f"{depth * 1e3:.0f} mm; Harrington et al. 2007)"
    )
    return out, note


def _head_and_trunk(m: _Markers, have: Tracks) -> Estimate:
    out: Tracks = {}
    fronts, backs = ([m.first(s, core) for s in SIDES] for core in ("fhd", "bhd"))
    if fronts[0] is not None and fronts[1] is not None and backs[0] is not None and backs[1] is not None:
        out["face"] = (fronts[0] + fronts[1]) / 2
        out["head"] = (fronts[0] + fronts[1] + backs[0] + backs[1]) / 4
    neck, chest = m.middle("", ("c7",), ("clav",)), m.middle("", ("t10",), ("strn",))
    _put(out, "neck", neck)
    _put(out, "spine 50", chest)
    return out, ""


def _lumbar(m: _Markers, have: Tracks) -> Estimate:
    """A point above the hips that moves with the pelvis' markers, so that they show its tilt."""
    pelvis = _pelvis(m)
    needed = [f"{s}_{p}" for p in ("hip", "shoulder") for s in SIDES]
    if pelvis is None or not all(place in have for place in needed):
        return {}, ""
    hips = (have["left_hip"] + have["right_hip"]) / 2
    line = (have["left_shoulder"] + have["right_shoulder"]) / 2 - hips
    frame = np.stack(_axes(pelvis), -1)
    own = np.nanmedian(np.einsum("tij,ti->tj", frame, _LUMBAR * line), axis=0) * (0.0, 1.0, 1.0)
    return {"spine 0": hips + frame @ own}, ""
