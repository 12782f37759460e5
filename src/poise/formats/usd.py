"""USD: an animated UsdSkel skeleton as a clip, and back with a figure to look at; needs `usd-core`."""

from __future__ import annotations

import importlib
import json
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.formats.figure import bone_figure
from poise.formats.limited import read_limited
from poise.formats.nodes import (
    base_of,
    checked_unit,
    rigid_bones,
    tips_from_z_up,
    turn_and_scale,
    unique_names,
)
from poise.formats.raw import RawMotion, ReadOptions, assemble, quats_from_z_up, vectors_from_z_up
from poise.formats.root_joint import Restored, restored
from poise.formats.text import MAX_JOINTS, MAX_VALUE, check_file, others_note, shown, write_whole
from poise.motion.clip import MAX_POSES, Clip
from poise.motion.clip_info import landmarks
from poise.motion.rotations import normalize, quat_mul, quat_rotate, unwrap_quats

_EVEN_SCALE = 1e-2
_SCRIPT = Path(__file__).with_name("usd_stage.py")


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
    return PoiseError("USD files need the package usd-core", hint=hint, code="extra-missing")


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
        turns = top[1]
        moved = quat_rotate(turns, (above * place[0]))
        place[0] = (top[0] + moved) / above
        turn[0] = quat_mul(turns, turn[0])
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
            f"its transform is no usable number at time code {codes[bad.argmax()]:g}",
            where,
            code="number-unusable",
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


def write_usd(clip: Clip, path: str | Path) -> None:
    """Writes a clip as USD: text for .usda, binary for .usd and .usdc.

    A UsdSkel skeleton with the source's joint names, order and hierarchy, its animation at the clip's
    own frames (time codes are frame numbers), and a figure of slim octahedra bound to it. A clip that
    came from USD keeps its unit and vertical; any other is in metres, Y up. The names stand in
    `jointNames`; joint paths get letters that USD allows.

    Raises:
        PoiseError: usd-core is not installed, or the file cannot be written.
    """
    pxr = pxr_package()
    path = Path(path)
    suffix = path.suffix.lower() if path.suffix.lower() in (".usda", ".usdc") else ".usdc"
    stage = pxr.Usd.Stage.CreateInMemory(f"poise{suffix}")
    _fill(pxr, stage, clip)
    if suffix == ".usda":
        write_whole(path, stage.GetRootLayer().ExportToString())
        return
    # Binary layers are written by the library alone, and only to a file.
    with tempfile.TemporaryDirectory() as folder:
        layer = Path(folder) / f"motion{suffix}"
        try:
            written = stage.GetRootLayer().Export(str(layer))
        except pxr.Tf.ErrorException:
            written = False
        if not written:
            raise PoiseError("USD could not make the file", path, code="cannot-write")
        write_whole(path, layer.read_bytes())


def _fill(pxr: Any, stage: Any, clip: Clip) -> None:
    Gf, UsdGeom, UsdSkel, Vt = pxr.Gf, pxr.UsdGeom, pxr.UsdSkel, pxr.Vt
    skeleton, source = clip.skeleton, clip.skeleton.source
    own = source.format == "usd"
    axis, unit = (source.up_axis, source.unit_m) if own else ("Y", 1.0)
    offsets = vectors_from_z_up(skeleton.offsets, axis) / unit
    root_pos = vectors_from_z_up(clip.root_pos, axis) / unit
    rot = unwrap_quats(normalize(quats_from_z_up(clip.rot, axis)))
    back = restored(skeleton, offsets, root_pos, rot) if own else Restored({0: root_pos}, offsets)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y if axis == "Y" else UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    stage.SetTimeCodesPerSecond(clip.fps)
    stage.SetFramesPerSecond(clip.fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(clip.frames - 1)
    top = UsdSkel.Root.Define(stage, "/Figure")
    stage.SetDefaultPrim(top.GetPrim())
    rig = UsdSkel.Skeleton.Define(stage, "/Figure/Skeleton")
    motion = UsdSkel.Animation.Define(stage, "/Figure/Skeleton/Motion")
    joints = Vt.TokenArray(_joint_paths(pxr, skeleton.names, skeleton.parents))
    rest = back.offsets.copy()
    for j, moves in back.paths.items():
        rest[j] = moves[0]
    world = rest.copy()
    for j, parent in enumerate(skeleton.parents):
        world[j] += world[parent] if parent >= 0 else 0.0

    def moved(places: np.ndarray) -> Any:
        return Vt.Matrix4dArray([Gf.Matrix4d(1).SetTranslate(Gf.Vec3d(*p.tolist())) for p in places])

    rig.CreateJointsAttr(joints)
    rig.CreateJointNamesAttr(Vt.TokenArray(list(skeleton.names)))
    rig.CreateRestTransformsAttr(moved(rest))
    rig.CreateBindTransformsAttr(moved(world))
    binding = UsdSkel.BindingAPI.Apply(rig.GetPrim())
    binding.CreateAnimationSourceRel().SetTargets([motion.GetPath()])
    tips = tips_from_z_up(skeleton, axis, unit)
    ends = [[j, *(float(x) for x in tip)] for j, tip in tips]
    motion.GetPrim().SetCustomDataByKey("poise", {"cyclic": clip.cyclic, "ends": json.dumps(ends)})
    motion.CreateJointsAttr(joints)
    motion.CreateScalesAttr(Vt.Vec3hArray(len(skeleton), Gf.Vec3h(1, 1, 1)))
    place, turn = motion.CreateTranslationsAttr(), motion.CreateRotationsAttr()
    for t in range(clip.frames):
        for j, moves in back.paths.items():
            rest[j] = moves[t]
        place.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(rest, dtype=np.float32)), t)
        # Arrays of quaternions are given to USD as xyzw.
        xyzw = np.ascontiguousarray(rot[t][:, [1, 2, 3, 0]], dtype=np.float32)
        turn.Set(Vt.QuatfArray.FromNumpy(xyzw), t)
    _add_figure(
        pxr, stage, skeleton.parents, world, [(j, world[j] + tip) for j, tip in tips], 1.0 / unit
    )


def _joint_paths(pxr: Any, names: tuple[str, ...], parents: tuple[int, ...]) -> list[str]:
    """Paths such as "Hips/Spine/Head" of letters, digits and underscores."""
    safe = unique_names([pxr.Tf.MakeValidIdentifier(name) for name in names], [])
    out: list[str] = []
    for j, parent in enumerate(parents):
        out.append(safe[j] if parent < 0 else f"{out[parent]}/{safe[j]}")
    return out


def _add_figure(
    pxr: Any,
    stage: Any,
    parents: tuple[int, ...],
    rest: np.ndarray,
    tips: list[tuple[int, np.ndarray]],
    metre: float,
) -> None:
    """A mesh of one octahedron per bone, each vertex bound to one joint."""
    Gf, UsdGeom, UsdSkel, Vt = pxr.Gf, pxr.UsdGeom, pxr.UsdSkel, pxr.Vt
    points, normals, owner = bone_figure(parents, rest, tips, metre)
    mesh = UsdGeom.Mesh.Define(stage, "/Figure/Body")
    vertices = points.astype(np.float32)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals.astype(np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray([3] * (len(points) // 3)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray(list(range(len(points)))))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack((vertices.min(0), vertices.max(0)))))
    mesh.CreateDisplayColorAttr([Gf.Vec3f(0.85, 0.45, 0.15)])
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets(["/Figure/Skeleton"])
    binding.CreateJointIndicesPrimvar(False, 1).Set(Vt.IntArray([int(j) for j in owner]))
    binding.CreateJointWeightsPrimvar(False, 1).Set(Vt.FloatArray([1.0] * len(owner)))
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1))
