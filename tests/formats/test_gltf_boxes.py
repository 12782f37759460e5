"""Boxes beside a motion in a glTF scene: their places, their faces, and the motion as before."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from poise.formats import read_clip
from poise.formats.figure import SceneBox, box_mesh
from poise.formats.gltf_write import write_gltf
from toy_policy import walk

BOX = SceneBox("seat1", (0.4, 0.2, 0.5), (1.0, 2.0, 0.25), math.pi / 2)


def test_a_box_is_where_it_stands():
    points, normals, centre = box_mesh(BOX, "Z", 1.0)
    assert centre == pytest.approx([1.0, 2.0, 0.25])
    # Turned by a quarter, its length lies along y.
    assert np.ptp(points, axis=0) == pytest.approx([0.2, 0.4, 0.5])
    sides = points.reshape(-1, 3, 3)
    across = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
    assert (across * normals[::3]).sum(-1).min() > 0
    assert (sides.mean(1) * normals[::3]).sum(-1).min() > 0


def test_boxes_follow_the_axes_and_the_unit_of_a_file():
    points, _, centre = box_mesh(BOX, "Y", 0.01)
    assert centre[1] == pytest.approx(25.0)
    assert np.ptp(points, axis=0)[1] == pytest.approx(50.0)


def test_a_motion_reads_the_same_with_a_box_beside_it(tmp_path: Path):
    clip = walk(0, 30)
    write_gltf(clip, tmp_path / "plain.glb")
    write_gltf(clip, tmp_path / "scene.glb", [BOX, SceneBox("step1", (1, 1, 1), (0, 0, 0))])
    plain, scene = (read_clip(tmp_path / f"{name}.glb") for name in ("plain", "scene"))
    assert plain.skeleton.names == scene.skeleton.names
    assert np.array_equal(plain.rot, scene.rot)
    assert np.array_equal(plain.root_pos, scene.root_pos)
