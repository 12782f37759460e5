"""USD files: the round trip, the stage's facts, refusals; skipped where usd-core is absent."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from handmade_motion_files import bvh_text, deepmimic_text
from handmade_numpy_files import odd_clip

from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from poise.motion import Clip
from poise.motion.rotations import quat_distance
from refusals import refused


@pytest.fixture
def pxr() -> Any:
    usd = pytest.importorskip("pxr.Usd")
    assert usd is not None
    from poise.formats.usd import pxr_package

    return pxr_package()


def clips(folder: Path) -> list[Clip]:
    (folder / "a.bvh").write_text(bvh_text())
    (folder / "a.txt").write_text(deepmimic_text(loop="wrap"))
    return [read_clip(folder / "a.bvh"), read_clip(folder / "a.txt")]


def same(a: Clip, b: Clip) -> None:
    assert a.skeleton.names == b.skeleton.names and a.skeleton.parents == b.skeleton.parents
    assert (a.frames, a.fps, a.cyclic) == (b.frames, b.fps, b.cyclic)
    for (_, tip), (_, other) in zip(a.skeleton.ends, b.skeleton.ends, strict=True):
        np.testing.assert_allclose(tip, other, atol=1e-6)
    np.testing.assert_allclose(a.positions(), b.positions(), atol=1e-5)
    angle = quat_distance(a.rot, b.rot).max()
    assert float(angle) < 1e-4


def test_without_the_package_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    clip = clips(tmp_path)[0]
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    for act in (lambda: write_clip(clip, tmp_path / "b.usda"), lambda: read_clip(tmp_path / "a.usda")):
        with pytest.raises(PoiseError) as error:
            act()
        assert "USD files need the package usd-core. Install it with: pip install" in str(error.value)
        assert "poise-motion[usd]" in str(error.value)


@pytest.mark.parametrize("suffix", [".usda", ".usd", ".usdc"])
def test_round_trip(pxr: Any, tmp_path: Path, suffix: str) -> None:
    for clip in clips(tmp_path):
        path = tmp_path / f"b{suffix}"
        write_clip(clip, path)
        once = read_clip(path)
        same(clip, once)
        write_clip(once, path)
        same(clip, read_clip(path))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.bvh", "a.txt", f"b{suffix}"]


@pytest.mark.parametrize(
    "source", ["other/bandai_bvh/dataset-1_dash_active_001.bvh", "deepmimic_txt/humanoid3d_walk.txt"]
)
def test_round_trip_of_real_clips(pxr: Any, data_dir: Path, tmp_path: Path, source: str) -> None:
    clip = read_clip(data_dir / source)
    write_clip(clip, tmp_path / "b.usd")
    same(clip, read_clip(tmp_path / "b.usd"))


def test_the_stage(pxr: Any, tmp_path: Path) -> None:
    """Unit, vertical, time codes and the skinned places as OpenUSD itself computes them."""
    clip = clips(tmp_path)[0]
    write_clip(clip, tmp_path / "b.usda")
    stage = pxr.Usd.Stage.Open(str(tmp_path / "b.usda"))
    assert pxr.UsdGeom.GetStageUpAxis(stage) == "Y" and pxr.UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetTimeCodesPerSecond() == clip.fps
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, clip.frames - 1)
    assert stage.GetDefaultPrim().GetPath() == "/Figure"
    cache = pxr.UsdSkel.Cache()
    cache.Populate(pxr.UsdSkel.Root(stage.GetDefaultPrim()), pxr.Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(pxr.UsdSkel.Skeleton(stage.GetPrimAtPath("/Figure/Skeleton")))
    for t in (0, 3, clip.frames - 1):
        places = np.array(query.ComputeJointSkelTransforms(t))[:, 3, :3]
        z_up = np.stack((places[:, 0], -places[:, 2], places[:, 1]), -1)
        np.testing.assert_allclose(z_up, clip.positions()[t], atol=1e-5)
    body = cache.GetSkinningQuery(stage.GetPrimAtPath("/Figure/Body"))
    assert body and body.HasJointInfluences() and body.GetNumInfluencesPerComponent() == 1


STAGE = """#usda 1.0
(
    upAxis = "Z"
    metersPerUnit = 0.01
    timeCodesPerSecond = 24
)
def SkelRoot "Top" (
    prepend apiSchemas = ["SkelBindingAPI"]
)
{
    double3 xformOp:translate = (100, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    rel skel:animationSource = </Top/Anim>
    def Skeleton "Rig" (
        prepend apiSchemas = ["SkelBindingAPI"]
    )
    {
        uniform token[] joints = ["Hips", "Hips/Head", "Hips/LeftFoot"]
        uniform matrix4d[] bindTransforms = [IDENTITY, IDENTITY, IDENTITY]
        uniform matrix4d[] restTransforms = [IDENTITY, IDENTITY, FOOT]
    }
    def SkelAnimation "Anim"
    {
        uniform token[] joints = ["Hips", "Hips/Head"]
        half3[] scales = [(1, 1, 1), (1, 1, 1)]
        quatf[] rotations = [(1, 0, 0, 0), (1, 0, 0, 0)]
        float3[] translations.timeSamples = {
            0: [(0, 0, 90), (0, 0, 70)],
            2: [(0, 20, 90), (0, 0, 70)],
            4: [(0, 40, 90), (0, 0, 70)],
        }
    }
}
""".replace("IDENTITY", "((1,0,0,0),(0,1,0,0),(0,0,1,0),(0,0,0,1))").replace(
    "FOOT", "((1,0,0,0),(0,1,0,0),(0,0,1,0),(10,0,-85,1))"
)


def test_a_stage_of_another_tool(pxr: Any, tmp_path: Path) -> None:
    """Centimetres, Z up, samples on every other frame, a joint that only rests, a root that is moved."""
    (tmp_path / "a.usda").write_text(STAGE)
    clip = read_clip(tmp_path / "a.usda")
    assert clip.skeleton.names == ("Hips", "Head", "LeftFoot")
    assert (clip.fps, clip.frames) == (12.0, 3)
    assert (clip.skeleton.source.unit_m, clip.skeleton.source.up_axis) == (0.01, "Z")
    np.testing.assert_allclose(clip.root_pos, [(1, 0.2 * k, 0.9) for k in range(3)], atol=1e-6)
    np.testing.assert_allclose(
        clip.positions()[1], [(1, 0.2, 0.9), (1, 0.2, 1.6), (1.1, 0.2, 0.05)], atol=1e-6
    )
    assert read_clip(tmp_path / "a.usda", fps=24).frames == 5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("#usda 1.0\n", "the file holds no animation of a skeleton (UsdSkel)"),
        ("#usda 1.0\ndef Xform {{{", "USD cannot read the file"),
        (
            "#usda 1.0\n(\n subLayers = [@../other.usda@]\n)\n",
            "it is put together from other files ('../other.usda'). Flatten it into one file first",
        ),
        (
            '#usda 1.0\ndef "A" ( references = @x.usd@</B> )\n{\n}\n',
            "it is put together from other files ('x.usd')",
        ),
        (
            STAGE.replace("(0, 20, 90)", "(0, nan, 90)"),
            "joint 'Hips': its transform is no usable number",
        ),
        (STAGE.replace('["Hips", "Hips/Head", "Hips', '["Hips/Head", "Hips", "Hips'), "parents before"),
        (STAGE.replace("restTransforms", "otherTransforms"), "do not give every joint a place"),
    ],
)
def test_refusals(pxr: Any, tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "a.usda"
    path.write_text(text)
    with pytest.raises(PoiseError) as error:
        read_clip(path)
    assert str(error.value).startswith(str(path)) and message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "text",
    [
        "#usda 1.0\n" + 'def "a" {' * 100_000 + "}" * 100_000,
        "#usda 1.0\n( customLayerData = " + "{ dictionary a = " * 50_000 + "{}" + "}" * 50_000 + ")",
    ],
    ids=["prims", "dictionaries"],
)
def test_what_crashes_the_library_is_a_refusal(pxr: Any, tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.usda"
    path.write_text(text)
    with pytest.raises(PoiseError) as error:
        read_clip(path)
    assert str(error.value).startswith(str(path)) and len(str(error.value)) < len(str(path)) + 200


def test_damaged_binary_files_are_refused(pxr: Any, tmp_path: Path) -> None:
    """One changed byte ended the whole process once, or failed long after the file was opened."""
    write_clip(odd_clip(), tmp_path / "a.usdc")
    whole = (tmp_path / "a.usdc").read_bytes()
    for at, value in ((97, 2), (len(whole) // 2, 255), (len(whole) - 40, 255)):
        (tmp_path / "a.usdc").write_bytes(whole[:at] + bytes([value]) + whole[at + 1 :])
        try:
            read_clip(tmp_path / "a.usdc")
        except PoiseError as error:
            assert str(error).startswith(str(tmp_path / "a.usdc"))


def test_few_keys_do_not_become_millions_of_frames(pxr: Any, tmp_path: Path) -> None:
    path, far = tmp_path / "a.usda", 8_329_166
    path.write_text(STAGE.replace("        4: [", f"        {far}: [").replace("= 24", "= 1000"))
    with refused("clip-too-long", says=("3 keys", "240")):
        read_clip(path)
