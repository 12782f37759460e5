"""Mistakes in glTF, USD and FBX files: each sentence names the file and the place; odd ones are read."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
from handmade_fbx_files import fbx_text
from handmade_gltf_files import Gltf, person, put, turn, walker

from poise.errors import PoiseError
from poise.formats import read_clip
from refusals import refused

needs_ufbx = pytest.mark.skipif(find_spec("ufbx") is None, reason="needs ufbx")


def refusal(path: Path, *told: Any) -> str:
    with refused(*told) if told else pytest.raises(PoiseError) as error:
        read_clip(path)
    message = str(error.value)
    assert message.startswith(str(path)) and message.isprintable()
    return message.removeprefix(str(path))


def sparse(**change: Any) -> Gltf:
    """The hips' path with one place replaced."""
    file, _ = walker()
    where, what = (
        file.view(np.array([2], "<u2").tobytes()),
        file.view(np.array([0, 1, 0], "<f4").tobytes()),
    )
    part = {
        "count": 1,
        "indices": {"bufferView": where, "componentType": 5123},
        "values": {"bufferView": what},
    }
    file.doc["accessors"][0]["sparse"] = {**part, **change}
    return file


def changed(change: Callable[[Gltf, dict[str, int]], object]) -> Gltf:
    file, at = walker()
    change(file, at)
    return file


CASES: dict[str, tuple[Callable[[], Gltf], str]] = {
    "sparse without values": (
        lambda: sparse(values=None), ": the sparse part of accessor 0"),
    "sparse beyond the elements": (lambda: sparse(count=8), ": accessor 0"),
    "sparse with signed indices": (
        lambda: sparse(indices={"bufferView": 0, "componentType": 5120}),
        ": the sparse indices of accessor 0"),
    "a rotation of no length": (
        lambda: changed(lambda f, at: f.doc["nodes"][1].update(rotation=[0, 0, 0, 0])),
        ", node 'Spine': its rotation is a quaternion of no length"),
    "a skin of one joint": (
        lambda: changed(lambda f, at: f.doc["skins"][0].update(joints=3)),
        ": the joints of skin 0 are no list"),
    "a matrix that mirrors": (
        lambda: changed(lambda f, at: _matrix(f, [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1])),
        ", node 'Spine': its matrix mirrors space"),
    "a matrix that flattens": (
        lambda: changed(lambda f, at: _matrix(f, [0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1])),
        ", node 'Spine': its matrix flattens space"),
    "a matrix that shears": (
        lambda: changed(lambda f, at: _matrix(f, [1, 0, 0, 0, 1, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1])),
        ", node 'Spine': its matrix shears space"),
}  # fmt: skip


def _matrix(file: Gltf, values: list[float]) -> None:
    file.doc["nodes"][1].pop("translation")
    file.doc["nodes"][1]["matrix"] = values


@pytest.mark.parametrize("case", CASES)
def test_a_mistake_is_named_with_its_place(tmp_path: Path, case: str) -> None:
    make, said = CASES[case]
    message = refusal(put(tmp_path, "a.gltf", make()))
    assert message.startswith(said), message


def test_an_address_that_is_a_number(tmp_path: Path) -> None:
    file, _ = walker()
    path = tmp_path / "a.gltf"
    path.write_text(file.gltf().replace('"uri": "data:', '"uri": 7, "was": "data:'))
    refusal(path, "wrong-type", "0")


def test_sparse_values_alone_stand_on_zeros(tmp_path: Path) -> None:
    plain = read_clip(put(tmp_path, "a.gltf", walker()[0]))
    clip = read_clip(put(tmp_path, "b.gltf", sparse()))
    # The hips of frame 2 stand at (0, 1, 0), Y up.
    assert np.allclose(clip.root_pos[2], (0, 0, 1), atol=1e-6)
    assert np.array_equal(np.delete(clip.root_pos, 2, 0), np.delete(plain.root_pos, 2, 0))
    file = sparse()
    file.doc["accessors"][0].pop("bufferView")
    clip = read_clip(put(tmp_path, "c.gltf", file))
    assert np.allclose(clip.root_pos, np.eye(7)[2][:, None] * (0, 0, 1), atol=1e-6)


def test_a_scale_that_differs_between_axes_is_told(tmp_path: Path) -> None:
    file = changed(lambda f, at: f.doc["nodes"][at["LeftLeg"]].update(scale=[1, 1, 1.2]))
    clip = read_clip(put(tmp_path, "a.gltf", file))
    assert any(
        "The scale of 'LeftLeg' differs between its axes" in n for n in clip.skeleton.source.notes
    )


def test_keys_that_lie_too_close_give_no_rate(tmp_path: Path) -> None:
    file, _ = walker(frames=7, fps=1e5)
    refusal(put(tmp_path, "a.gltf", file), "clip-too-short", "1")


def test_one_key_of_a_joint_holds_it_still(tmp_path: Path) -> None:
    file, at = walker()
    file.channel(file.doc["animations"][0], at["Spine"], "rotation", [0.0], [turn("x", 30.0)])
    clip = read_clip(put(tmp_path, "a.gltf", file))
    spine = clip.rot[:, clip.skeleton.index("Spine")]
    assert np.ptp(spine, axis=0).max() == 0 and abs(spine[0, 0]) < 0.99


def test_an_animation_of_what_stands_above_the_figure(tmp_path: Path) -> None:
    file = Gltf()
    armature = file.node("Armature")
    file, _ = person(armature, file)
    path = [(0, 0, 0.1 * k) for k in range(4)]
    file.channel(file.animation(), armature, "translation", [k / 30 for k in range(4)], path)
    clip = read_clip(put(tmp_path, "a.gltf", file))
    # It moves, so it is the root.
    assert clip.skeleton.names[:2] == ("Armature", "Hips")
    assert np.allclose(clip.root_pos, [(0, -0.1 * k, 0) for k in range(4)], atol=1e-6)


def test_joints_under_another_root_are_left_out(tmp_path: Path) -> None:
    file, at = walker()
    hand = file.node("LooseHand", translation=[1, 1, 1])
    file.doc["skins"] = [{"joints": [*at.values(), hand]}, {"joints": [hand]}]
    clip = read_clip(put(tmp_path, "a.gltf", file))
    assert clip.skeleton.names == tuple(at)
    assert any("1 joints that hang on no common node" in n for n in clip.skeleton.source.notes)


@needs_ufbx
def test_fbx_files_of_two_takes_and_beyond_the_limits(tmp_path: Path) -> None:
    from poise.formats.fbx_scene import read

    path = tmp_path / "a.fbx"
    path.write_text(fbx_text())

    def refuse(what: str, hint: str | None = None, code: str = "") -> NoReturn:
        raise PoiseError(what, code=code)

    limits: dict[str, Any] = {"joints": 99, "poses": 1000, "value": 1e6, "fps": None, "take": None}
    assert read(str(path), refuse, **limits)["local"].shape[:2] == (8, 9)
    for change, *told in (
        ({"joints": 8}, "joint-count", ("9", "8")),
        ({"poses": 71}, "clip-too-long", ("8 frames", "9 joints", "71")),
        ({"fps": 1e9}, "times-unusable"),
    ):
        with refused(*told):
            read(str(path), refuse, **{**limits, **change})
