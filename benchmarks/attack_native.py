"""Hostile USD and MJCF files, read by native libraries, for `attack.py`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from attack_case import WALK, case, read

from poise.formats import read_clip, write_clip
from poise.motion import Clip


@case("USD, 100,000 nested prims")
def _(folder: Path) -> Any:
    return read(folder, "a.usda", "#usda 1.0\n" + 'def "a" {' * 100_000 + "}" * 100_000)


@case("USD, 50,000 nested dictionaries")
def _(folder: Path) -> Any:
    text = "{ dictionary a = " * 50_000 + "{}" + "}" * 50_000
    return read(folder, "a.usda", "#usda 1.0\n( customLayerData = " + text + ")")


@case("USD, a value of 100,000 brackets")
def _(folder: Path) -> Any:
    text = 'def "a" {\ncustom float3 x = ' + "(" * 100_000 + "1" + ")" * 100_000 + "\n}"
    return read(folder, "a.usda", "#usda 1.0\n" + text)


@case("USD in bytes, byte 97 set to 2")
def _(folder: Path) -> Any:
    write_clip(read_clip(WALK), folder / "a.usdc")
    data = (folder / "a.usdc").read_bytes()
    return read(folder, "b.usdc", data[:97] + b"\x02" + data[98:])


@case("USD, 1,999,000 poses out of four keys")
def _(folder: Path) -> Any:
    return few_keys(folder, 1_999_000)


@case("USD, 200,000 poses out of four keys")
def _(folder: Path) -> Any:
    return few_keys(folder, 200_000)


def few_keys(folder: Path, poses: int) -> Clip:
    """Three joints with four keys that lie so that their common step makes many poses."""
    joints = '["a", "a/b", "a/b/c"]'
    still = "[(1, 0, 0, 0), (1, 0, 0, 0), (1, 0, 0, 0)]"
    keys = "".join(f"{t}: {still}, " for t in (0, 1, 3, poses - 1))
    places = "".join(f"{t}: [({0.1 * k}, 1, 0), (0, 0.5, 0), (0, 0.4, 0)], "
                     for k, t in enumerate((0, 1, 3, poses - 1)))  # fmt: skip
    eye = "( (1,0,0,0), (0,1,0,0), (0,0,1,0), (0,0,0,1) )"
    text = f"""#usda 1.0
( metersPerUnit = 1
  upAxis = "Y"
  timeCodesPerSecond = 1000 )
def SkelRoot "r" {{
  def Skeleton "s" ( prepend apiSchemas = ["SkelBindingAPI"] ) {{
    uniform token[] joints = {joints}
    uniform matrix4d[] bindTransforms = [{eye}, {eye}, {eye}]
    uniform matrix4d[] restTransforms = [{eye}, {eye}, {eye}]
    rel skel:animationSource = </r/m>
  }}
  def SkelAnimation "m" {{
    uniform token[] joints = {joints}
    quatf[] rotations.timeSamples = {{ {keys} }}
    half3[] scales = [(1, 1, 1), (1, 1, 1), (1, 1, 1)]
    float3[] translations.timeSamples = {{ {places} }}
  }}
}}
"""
    return read(folder, "a.usda", text)


@case("USD that refers to itself")
def _(folder: Path) -> Any:
    return read(folder, "a.usda", '#usda 1.0\ndef "R" ( references = </R> )\n{\n}\n')


def mjcf(line: str, folder: Path) -> Any:
    """A body with one hostile line."""
    from poise.body import read_mjcf

    head = "<mujoco><worldbody><body name='pelvis'><freejoint/><geom size='.1'/></body></worldbody>"
    (folder / "a.xml").write_text(f"{head}{line}</mujoco>")
    return read_mjcf(folder / "a.xml")


for _name, _line in {
    "texture": "<asset><texture type='2d' builtin='flat' width='60000' height='60000'/></asset>",
    "hfield": "<asset><hfield name='h' nrow='40000' ncol='40000' size='1 1 1 1'/></asset>",
    "nuserdata": "<size nuserdata='2000000000'/>",
    "nkey": "<size nkey='2000000000'/>",
    "replicate": "<worldbody><replicate count='100000'><body/></replicate></worldbody>",
    "flexcomp": "<worldbody><flexcomp name='f' type='grid' count='300 300 300' dim='3'/></worldbody>",
    "include": "<include file='../../secret.xml'/>",
    "plug-in": "<extension><plugin plugin='mujoco.elasticity.cable'/></extension>",
    "nested": "<worldbody>" + "<body>" * 20_000 + "</body>" * 20_000 + "</worldbody>",
}.items():
    case(f"MJCF, {_name}")(lambda f, x=_line: mjcf(x, f))  # type: ignore[misc]
