"""USD files (.usda, .usd, .usdc, .usdz) as clips: an animated UsdSkel skeleton; needs `usd-core`."""

from __future__ import annotations

import importlib
import json
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch

from poise.errors import PoiseError
from poise.motion.clip import MAX_POSES, Clip
from poise.motion.info import landmarks
from poise.motion.io.limited import read_limited
from poise.motion.io.nodes import base_of, checked_unit, rigid_bones, turn_and_scale, unique_names
from poise.motion.io.raw import RawMotion, ReadOptions, assemble
from poise.motion.io.text import MAX_JOINTS, MAX_VALUE, check_file, others_note, shown
from poise.spatial import quat_mul, quat_rotate

_EVEN_SCALE = 1e-2
_SCRIPT = Path(__file__).with_name("stage.py")


def pxr_package() -> Any:
    """OpenUSD's Python package with the parts that are needed here, loaded late."""
    try:
        for part in ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdSkel", "Vt"):
            importlib.import_module(f"pxr.{part}")
        return importlib.import_module("pxr")
    except ImportError:
        raise _missing() from None


def _missing() -> PoiseError:
    hint = "Install it with: pip install 'poise-motion[usd]'"
    return PoiseError("USD files need the package usd-core", hint=hint)


def read_usd(path: Path, options: ReadOptions) -> Clip:
    """The first animated UsdSkel skeleton of a .usda, .usd, .usdc or .usdz file.

    Transforms above the skeleton count at every time code; where they move, the root joint carries
    their motion. Unit and vertical are the stage's. The file must stand alone: layers, references and
    payloads in other files are refused, not opened. OpenUSD reads it in a process of its own, see
    `limited`.

    Raises:
        PoiseError: usd-core is not installed, the file is damaged, or it holds no skeleton in motion.
    """
    if find_spec("pxr") is None:
        raise _missing()
    size, fps = check_file(path), options.fps
    limits = {"joints": MAX_JOINTS, "poses": MAX_POSES, "value": MAX_VALUE, "fps": fps}
    limits["rest"] = options.rest
    held = read_limited(_SCRIPT, path, size, "USD file", **limits)
    return assemble(raw_of_matrices(held, "USD", path, options), options)


def raw_of_matrices(
    held: dict[str, np.ndarray], form: str, path: Path, options: ReadOptions
) -> RawMotion:
    """The motion of a skeleton that a script has read joint by joint as matrices, see `usd.stage`."""
    notes = [str(n) for n in held["notes"]]
    others = [str(n) for n in held.get("others", ())]
    if others:
        counts = [int(n) for n in held["others_joints"]]
        name = str(held["skeleton"][0])
        notes.append(others_note(name, len(held["names"]), list(zip(others, counts, strict=True))))
    held = _one_root(held, notes)
    parents = [int(p) for p in held["parents"]]
    names = unique_names([str(n) for n in held["names"]], notes)
    codes, local = held["codes"], held["local"]
    top = _parts(held["above"], f"{path}, the skeleton's own transform", codes)
    place, turn, scale = _all_parts(local, [f"{path}, joint {shown(n)}" for n in names], codes)
    steady = [np.median(s, axis=0) for s in scale]
    above = np.median(top[2], axis=0)
    for name, one in (("the skeleton", top[2]), *zip(map(shown, names), scale, strict=True)):
        if np.ptp(one, axis=0).max() > _EVEN_SCALE * np.abs(one).max():
            notes.append(f"The scale of {name} is animated; its median was taken for all frames")
    if len(top[0]) > 1:
        # The root joint carries what moves above it: x = p_above + R_above (s x_root).
        turns = torch.tensor(top[1])
        moved = quat_rotate(turns, torch.tensor(above * place[0])).numpy()
        place[0] = (top[0] + moved) / above
        turn[0] = quat_mul(turns, torch.tensor(turn[0])).numpy()
        base = base_of([(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), above)])
    else:
        base = base_of([(top[0][0], top[1][0], above)])
    bones = rigid_bones(names, parents, place, turn, steady, base, len(local), notes)
    up, unit = str(held["up"]), float(held["unit"])
    return RawMotion(
        format=form.lower(),
        path=path,
        names=names,
        parents=tuple(parents),
        offsets=bones.offsets,
        ends=_ends(str(held["ends"]), len(names)),
        root_pos=bones.root_pos,
        rot=bones.rot,
        fps=float(held["fps"]),
        channels=(),
        unit_m=checked_unit(form, unit, up, names, parents, bones, options, path, notes),
        up_axis=up,
        travel_joint=None if bones.carried.joint is None else names[bones.carried.joint],
        cyclic=bool(held["cyclic"]),
        notes=tuple(notes),
        strays=bones.carried.strays,
        beside=bones.carried.beside,
        extra=bones.carried.extra,
        whole=bool(held["whole"]),
    )


def _one_root(held: dict[str, np.ndarray], notes: list[str]) -> dict[str, np.ndarray]:
    """The same with one root joint: of several people one, and a still root above what has several.

    held: "parents" may have several roots, -1, each before its children.
    """
    parents = [int(p) for p in held["parents"]]
    if parents.count(-1) < 2:
        return held
    top: list[int] = []
    for j, up in enumerate(parents):
        top.append(j if up < 0 else top[up])
    names, tops = [str(n) for n in held["names"]], np.array(top)
    trees = {t: np.flatnonzero(tops == t) for t in sorted(set(top))}

    def whole(joints: np.ndarray) -> bool:
        heads, _, ankles = landmarks([names[j] for j in joints])
        return bool(heads) and len(ankles) > 1

    people = [t for t, joints in trees.items() if whole(joints)]
    if len(people) > 1:
        best = max(people, key=lambda t: len(trees[t]))
        others = [(names[t], len(trees[t])) for t in people if t != best]
        notes.append(others_note(names[best], len(trees[best]), others))
        keep = trees[best]
        new = {int(j): k for k, j in enumerate(keep)}
        made = np.array([new.get(parents[j], -1) for j in keep])
        return {**held, "names": held["names"][keep], "parents": made, "local": held["local"][:, keep]}
    still = np.broadcast_to(np.eye(4), (len(held["local"]), 1, 4, 4))
    return {
        **held,
        "names": np.array([str(held["skeleton"][0]) if "skeleton" in held else "Root", *names]),
        "parents": np.array([-1, *(p + 1 for p in parents)]),
        "local": np.concatenate((still, held["local"]), 1),
        "ends": np.array(""),
    }


def _all_parts(
    local: np.ndarray, where: list[str], codes: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Places, turns and scales of joints' matrices `(T, J, 4, 4)`, joint by joint."""
    try:
        frames, joints = local.shape[:2]
        place, turn, scale = _parts(local.reshape(-1, 4, 4), "", np.repeat(codes, joints))
        parts = [x.reshape(frames, joints, -1).swapaxes(0, 1) for x in (place, turn, scale)]
    except PoiseError:
        # One by one, so that the refusal names the joint.
        each = [_parts(local[:, j], place, codes) for j, place in enumerate(where)]
        parts = [np.stack(x) for x in zip(*each, strict=True)]
    return list(parts[0]), list(parts[1]), list(parts[2])


def _parts(m: np.ndarray, where: str, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places `(T, 3)`, turns `(T, 4)` wxyz and scales `(T, 3)` of row-vector matrices `(T, 4, 4)`."""
    bad = ~(np.abs(m) <= MAX_VALUE).all((1, 2))
    if bad.any():
        raise PoiseError(
            f"its transform is no usable number at time code {codes[bad.argmax()]:g}", where
        )
    turn, scale = turn_and_scale(m[:, :3, :3].transpose(0, 2, 1), "transform", where)
    return m[:, 3, :3], turn, scale


def _ends(text: str, joints: int) -> tuple[tuple[int, tuple[float, float, float]], ...]:
    """Bone tips that Poise wrote beside the animation, in file units."""
    try:
        rows = json.loads(text or "[]")
        tips = [(int(j), (float(x), float(y), float(z))) for j, x, y, z in rows]
    except (TypeError, ValueError, OverflowError, RecursionError):
        return ()
    return tuple((j, tip) for j, tip in tips if 0 <= j < joints and max(map(abs, tip)) <= MAX_VALUE)
