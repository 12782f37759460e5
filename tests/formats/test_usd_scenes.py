"""USD scenes: transforms that move above a skeleton, bindings, packages, stills, several bodies."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from handmade_rigs import FPS, Rig, skeleton_of, usda_of, walker
from scipy.spatial.transform import Rotation

from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from poise.formats.table import read_skeleton
from poise.motion import Clip
from refusals import refused

pytest.importorskip("pxr")


def read(folder: Path, text: str) -> Clip:
    (folder / "a.usda").write_text(text)
    return read_clip(folder / "a.usda")


def check(clip: Clip, rig: Rig, want: np.ndarray | None = None) -> None:
    want = rig.world() if want is None else want
    got = clip.positions()[:, [clip.skeleton.index(n) for n in rig.names]]
    assert got.shape == want.shape and np.abs(got - want).max() < 1e-4


def up(v: np.ndarray) -> np.ndarray:
    """Y up as Z up."""
    return np.stack((v[..., 0], -v[..., 2], v[..., 1]), -1)


def test_a_moving_root_prim_carries_the_skeleton(tmp_path: Path) -> None:
    rig = walker(speed=0.0)
    keys = {t: (0.05 * t, 0.001 * t * t, 0.0) for t in range(31)}
    clip = read(tmp_path, usda_of(skeleton_of(rig), keys))
    check(clip, rig, rig.world() + up(np.array(list(keys.values())))[:, None])
    assert (clip.frames, clip.fps) == (31, FPS)
    for suffix in ("usda", "bvh", "glb"):
        write_clip(clip, tmp_path / f"b.{suffix}")
        assert np.abs(read_clip(tmp_path / f"b.{suffix}").positions() - clip.positions()).max() < 1e-4


@pytest.mark.parametrize("coarse", ["joints", "transform"])
def test_samples_at_other_codes(tmp_path: Path, coarse: str) -> None:
    """The finer of both sets the frames; between the keys of the other USD goes in a straight line."""
    rig = walker(speed=0.0)
    if coarse == "joints":
        # Joints at every second code, the transform at every code.
        text = usda_of(skeleton_of(rig, step=2.0), {t: (0, 0, 0.01 * t * t) for t in range(61)})
        clip = read(tmp_path, text)
        assert (clip.frames, clip.fps) == (61, FPS)
        shift = up(np.array([(0, 0, 0.01 * t * t) for t in range(0, 61, 2)]))
        check(
            clip.replaced(root_pos=clip.root_pos[::2], rot=clip.rot[::2]),
            rig,
            rig.world() + shift[:, None],
        )
        np.testing.assert_allclose(clip.root_pos[1, 1] - clip.root_pos[0, 1], -0.01, atol=1e-5)
    else:
        # The transform has three keys, one before the joints begin to move and one after.
        text = usda_of(skeleton_of(rig), {-5: (0, 0, 0), 10: (1.5, 0, 0), 40: (1.5, 0, 3.0)})
        clip = read(tmp_path, text)
        assert (clip.frames, clip.fps) == (46, FPS)
        t = np.arange(-5, 41)
        path = np.stack((np.interp(t, (-5, 10), (0, 1.5)), 0 * t, np.interp(t, (10, 40), (0, 3.0))), -1)
        world = rig.world()[np.clip(t, 0, 30)]
        check(clip, rig, world + up(path)[:, None])


def test_several_levels_above_turn_and_scale(tmp_path: Path) -> None:
    """An Xform that turns, a SkelRoot that travels, an Xform of scale 0.01 with bones in centimetres."""
    rig = walker()
    large = Rig(rig.names, rig.parents, tuple(100 * p for p in rig.place), rig.turn)
    inner = (
        'def Xform "Bones"\n{\nfloat3 xformOp:scale = (0.01, 0.01, 0.01)\n'
        'uniform token[] xformOpOrder = ["xformOp:scale"]\n' + skeleton_of(large) + "}\n"
    )
    text = usda_of(inner, {t: (0.1 * t, 0, 0) for t in range(31)})
    turn = ", ".join(f"{t}: {3 * t}" for t in range(31))
    head = (
        f'def Xform "World"\n{{\nfloat xformOp:rotateY.timeSamples = {{ {turn} }}\n'
        'uniform token[] xformOpOrder = ["xformOp:rotateY"]\n'
    )
    text = text.replace('def SkelRoot "Model"', head + 'def SkelRoot "Model"') + "}\n"
    clip = read(tmp_path, text)
    y_up = np.stack((rig.world()[..., 0], rig.world()[..., 2], -rig.world()[..., 1]), -1)
    y_up[..., 0] += 0.1 * np.arange(31)[:, None]
    turned = [Rotation.from_rotvec((0, np.radians(3 * t), 0)).apply(y_up[t]) for t in range(31)]
    check(clip, rig, up(np.stack(turned)))


def test_what_only_a_transform_moves_is_read(tmp_path: Path) -> None:
    rig = walker()
    still = Rig(rig.names, rig.parents, tuple(p[:1] for p in rig.place),
                tuple(Rotation.from_quat(q.as_quat()[:1]) for q in rig.turn))  # fmt: skip
    clip = read(tmp_path, usda_of(skeleton_of(still), {t: (0, 0, 0.1 * t) for t in range(11)}))
    check(clip, still, still.world() + up(np.array([(0, 0, 0.1 * t) for t in range(11)]))[:, None])
    # And a pose that nothing moves is two frames of it.
    clip = read(tmp_path, usda_of(skeleton_of(still)))
    check(clip, still, np.repeat(still.world(), 2, 0))
    assert "Nothing moves in it: its 2 frames show one pose" in clip.skeleton.source.notes


def test_a_binding_without_its_api_counts(tmp_path: Path) -> None:
    rig = walker()
    clip = read(tmp_path, usda_of(skeleton_of(rig, binding=False)))
    check(clip, rig)
    assert any("without SkelBindingAPI" in n for n in clip.skeleton.source.notes)
    # Below a plain Xform, which is no SkelRoot, too.
    clip = read(tmp_path, usda_of(skeleton_of(rig)).replace("SkelRoot", "Xform"))
    check(clip, rig)


def test_a_rig_without_animation_serves_as_a_target(tmp_path: Path) -> None:
    rig = walker()
    rested = usda_of(skeleton_of(rig)).replace("rel skel:animationSource = <Anim>", "")
    with refused("no-animation", says="SkelBindingAPI"):
        read(tmp_path, rested)
    clip = read_skeleton(tmp_path / "a.usda")
    assert clip.frames == 2 and clip.skeleton.names == rig.names


def test_others_are_named_and_roots_are_joined(tmp_path: Path) -> None:
    a, b = walker(), walker(prefix="B_")
    clip = read(tmp_path, usda_of(skeleton_of(a, "Anna") + skeleton_of(b, "Ben")))
    check(clip, a)
    assert (
        "The file holds 2 bodies: 'Anna' (18 joints) was read, and the other one was left out: "
        "'/Model/Ben' (18 joints); to read another, export it alone"
    ) in clip.skeleton.source.notes
    # Two people in one skeleton; and one person beside whom targets have roots of their own.
    k = len(a.names)
    both = Rig(a.names + b.names, (*a.parents, *(p + k if p >= 0 else -1 for p in b.parents)),
               a.place + b.place, a.turn + b.turn)  # fmt: skip
    clip = read(tmp_path, usda_of(skeleton_of(both)))
    check(clip, a)
    assert any("'B_pelvis' (18 joints)" in n for n in clip.skeleton.source.notes)
    ik = Rig((*a.names, "ik_hand"), (*a.parents, -1), (*a.place, a.place[0] + 0.2), (*a.turn, a.turn[0]))
    clip = read(tmp_path, usda_of(skeleton_of(ik)))
    check(clip, a)
    assert clip.skeleton.names[0] == "Skel" and "ik_hand" in clip.skeleton.names


def package(data: bytes, name: str, method: int = 0) -> bytes:
    """A zip of one file, without its directory, which is not needed."""
    name_bytes = name.encode()
    head = struct.pack("<4s5H3I2H", b"PK\x03\x04", 10, 0, method, 0, 0, zlib.crc32(data), len(data),
                       len(data), len(name_bytes), 0)  # fmt: skip
    return head + name_bytes + data


def test_packages(tmp_path: Path) -> None:
    rig = walker()
    text = usda_of(skeleton_of(rig)).encode()
    path = tmp_path / "a.usdz"
    path.write_bytes(package(text, "scene.usda"))
    check(read_clip(path), rig)
    for data, said in (
        (package(text, "scene.usda", 8), "no plain USD layer"),
        (package(text, "scene.usda")[:-100], "USD cannot read the file"),
        (package(b'#usda 1.0\ndef "A" ( references = @x.usd@</B> )\n{\n}\n', "a.usda"), "('x.usd')"),
        (package(b"", "a.usda"), "USD cannot read the file"),
    ):
        path.write_bytes(data)
        with pytest.raises(PoiseError) as error:
            read_clip(path)
        assert said in str(error.value)
