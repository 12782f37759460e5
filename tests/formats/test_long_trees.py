"""Skeletons of very many joints: read without recursion and without squares, or refused at once."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from handmade_gltf_files import Gltf

from poise.body.topology import find_limbs
from poise.formats import read_clip
from poise.formats.nodes import unique_names
from poise.formats.text import MAX_JOINTS
from poise.motion import find_roles
from poise.motion.clip_info import describe
from refusals import refused


def chain(count: int) -> str:
    """BVH of joints that hang one on another, 1.7 m in all."""
    lines = ["HIERARCHY"]
    for j in range(count):
        lines += [f"{'JOINT' if j else 'ROOT'} b{j}", "{", f"OFFSET 0 {170 / count:.6f} 0"]
        lines.append("CHANNELS 3 Zrotation Xrotation Yrotation")
    lines += ["}"] * count + ["MOTION", "Frames: 2", "Frame Time: 0.03"]
    return "\n".join([*lines, *[" ".join(["0"] * 3 * count)] * 2]) + "\n"


def test_a_chain_is_read_and_walked(tmp_path: Path) -> None:
    path = tmp_path / "a.bvh"
    path.write_text(chain(1400))
    began = time.process_time()
    clip = read_clip(path)
    assert len(clip.skeleton) == 1400
    np.testing.assert_allclose(clip.positions()[0, -1], (0, 0, 1.7), atol=1e-4)
    assert describe(clip)["height_m"] == pytest.approx(1.7, rel=0.01)
    assert not find_roles(clip.skeleton).rows and find_limbs(clip.skeleton) is None
    assert time.process_time() - began < 20
    for count in (MAX_JOINTS + 1, 5000):
        path.write_text(chain(count))
        with refused("too-many-joints", says=str(MAX_JOINTS)):
            read_clip(path)


def test_many_joints_of_one_name(tmp_path: Path) -> None:
    file = Gltf()
    root = file.node("bone", translation=[0, 0.9, 0])
    nodes = [root, *(file.node("bone", root, translation=[0, 0.8, 0.001 * k]) for k in range(1399))]
    file.doc["skins"] = [{"joints": nodes}]
    file.channel(file.animation(), root, "translation", [0, 0.1], [(0, 0.9, 0), (0, 0.9, 0.1)])
    (tmp_path / "a.glb").write_bytes(file.glb())
    began = time.process_time()
    clip = read_clip(tmp_path / "a.glb")
    assert len(set(clip.skeleton.names)) == 1400 and clip.skeleton.names[-1] == "bone_1400"
    said = [n for n in clip.skeleton.source.notes if "name" in n]
    assert len(said) == 6 and said[-1] == "1394 more joints got another name, since theirs was taken"
    assert find_limbs(clip.skeleton) is None
    assert time.process_time() - began < 20


def test_names_are_made_unique_in_a_straight_line() -> None:
    notes: list[str] = []
    assert unique_names(["a", "a", "a_2", "b", "a"], notes) == ("a", "a_3", "a_2", "b", "a_4")
    names = unique_names(["x"] * 20_000, notes)
    assert len(set(names)) == 20_000 and names[-1] == "x_20000"
