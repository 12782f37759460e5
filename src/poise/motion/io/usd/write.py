"""Clips as USD: a UsdSkel skeleton, its animation, a figure to look at; needs `usd-core`."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.io.figure import bone_figure
from poise.motion.io.nodes import tips_from_z_up, unique_names
from poise.motion.io.raw import quats_from_z_up, vectors_from_z_up
from poise.motion.io.text import write_whole
from poise.motion.io.travel import Restored, restored
from poise.motion.io.usd.read import pxr_package
from poise.spatial import normalize, unwrap_quats


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
            raise PoiseError("USD could not make the file", path)
        write_whole(path, layer.read_bytes())


def _fill(pxr: Any, stage: Any, clip: Clip) -> None:
    Gf, UsdGeom, UsdSkel, Vt = pxr.Gf, pxr.UsdGeom, pxr.UsdSkel, pxr.Vt
    skeleton, source = clip.skeleton, clip.skeleton.source
    own = source.format == "usd"
    axis, unit = (source.up_axis, source.unit_m) if own else ("Y", 1.0)
    offsets = vectors_from_z_up(skeleton.offsets, axis) / unit
    root_pos = vectors_from_z_up(clip.root_pos, axis) / unit
    rot = unwrap_quats(normalize(torch.tensor(quats_from_z_up(clip.rot, axis)))).numpy()
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
