"""FBX: the same poses as the angles in the file say, in metres and Z up; damaged files in a sentence."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest
from handmade_fbx_files import BONES, fbx_text, travel, turns
from scipy.spatial.transform import Rotation

from poise.formats import fbx as fbx_read
from poise.formats import read_clip
from poise.formats.fbx_scene import skeleton
from refusals import refused

needs_ufbx = pytest.mark.skipif(find_spec("ufbx") is None, reason="needs ufbx")


def put(folder: Path, text: str) -> Path:
    path = folder / "a.fbx"
    path.write_text(text)
    return path


def expected(frames: int) -> np.ndarray:
    """Places of the joints `(T, J, 3)` in metres, Z up."""
    out = np.zeros((frames, len(BONES), 3))
    for t in range(frames):
        turn: list[Rotation] = []
        for j, (_, parent, place) in enumerate(BONES):
            own = Rotation.from_euler("xyz", turns(j, t), degrees=True)
            if parent < 0:
                turn.append(own)
                out[t, j] = travel(t)
            else:
                turn.append(turn[parent] * own)
                out[t, j] = out[t, parent] + turn[parent].apply(place)
    return np.stack((out[..., 0], -out[..., 2], out[..., 1]), -1) / 100


@needs_ufbx
def test_the_pose_is_what_the_angles_say(tmp_path: Path) -> None:
    clip = read_clip(put(tmp_path, fbx_text()))
    assert clip.skeleton.names == tuple(name for name, _, _ in BONES)
    assert clip.fps == 30 and clip.frames == 8 and clip.skeleton.source.format == "fbx"
    assert np.abs(clip.positions() - expected(8)).max() < 1e-6


@needs_ufbx
def test_z_up_takes_and_rates(tmp_path: Path) -> None:
    path = put(tmp_path, fbx_text(up=2))
    clip = read_clip(path, take="Walk", fps=60.0)
    assert clip.fps == 60 and clip.frames == 15
    # The file's Y is up no more: what was up lies along the floor.
    assert np.ptp(clip.positions()[0, :, 2]) < np.ptp(clip.positions()[0, :, 1])
    with refused("unknown-take", says=("Run", "Walk")):
        read_clip(path, take="Run")


@needs_ufbx
@pytest.mark.parametrize(
    ("text", "said"),
    [
        (fbx_text(bones=False), "no-joints"),
        (fbx_text(moves=False), "no-animation"),
        (fbx_text()[:3000], "file-damaged"),
        ("; FBX 7.4.0 project file\n" + "a: {" * 100_000, "file-damaged"),
    ],
)
def test_what_is_no_motion_is_refused(tmp_path: Path, text: str, said: str) -> None:
    path = put(tmp_path, text)
    with refused(said) as error:
        read_clip(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


def test_without_the_package_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fbx_read, "find_spec", lambda name: None)
    with refused("extra-missing", says="ufbx"):
        read_clip(put(tmp_path, fbx_text()))


def test_the_skeleton_is_the_largest_tree_of_bones_below_what_moves() -> None:
    def refuse(what: str, hint: str | None = None, code: str = "") -> NoReturn:
        raise ValueError(what)

    # File, armature, empty, hips, prop below no bone, spine, mesh, head below the mesh, another bone.
    above, bones = [-1, 0, 1, 2, 1, 3, 3, 6, 0], [k in (3, 5, 7, 8) for k in range(9)]
    notes: list[str] = []
    found = skeleton(above, bones, lambda k: False, refuse, notes)
    assert found == ([3, 5, 6, 7], [-1, 0, 0, 2])
    assert notes == ["Of 2 skeletons the largest was taken, of 3 bones"]
    # The armature moves, the empty below it does not.
    found = skeleton(above, bones, lambda k: k == 1, refuse, [])
    assert found == ([1, 2, 3, 5, 6, 7], [-1, 0, 1, 2, 2, 4])
    assert skeleton([1, 0, -1], [True, True, True], lambda k: False, refuse, []) == ([2], [-1])
    with pytest.raises(ValueError, match="no bones"):
        skeleton([-1, 0], [False, False], lambda k: False, refuse, [])
    deep = skeleton(list(range(-1, 50_000)), [True] * 50_001, lambda k: False, refuse, [])
    assert len(deep[0]) == 50_001
