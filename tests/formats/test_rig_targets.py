"""Rigs without an animation as targets of retargeting, in every format that can hold one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from handmade_rigs import bvh_of, fbx_of, gltf_of, skeleton_of, usda_of, walker
from scipy.spatial.transform import Rotation

from poise.formats import read_clip, write_clip
from poise.formats.table import read_skeleton
from poise.kinematics import RetargetConfig, retarget


@pytest.mark.parametrize("suffix", ["bvh", "glb", "usda", "fbx"])
def test_a_walk_onto_a_rig(tmp_path: Path, suffix: str) -> None:
    """The source's own rig takes its motion joint by joint."""
    walk, path = walker(), tmp_path / f"rig.{suffix}"
    rig = replace(walk, turn=(Rotation.identity(walk.frames),) * len(walk.names))
    if suffix == "bvh":
        path.write_text(bvh_of(rig).split("MOTION")[0] + "MOTION\nFrames: 0\nFrame Time: 0.03\n")
    elif suffix == "glb":
        file = gltf_of(rig)
        file.doc["animations"] = []
        path.write_bytes(file.glb())
    elif suffix == "usda":
        pytest.importorskip("pxr")
        path.write_text(usda_of(skeleton_of(rig)).replace("rel skel:animationSource = <Anim>", ""))
    else:
        pytest.importorskip("ufbx")
        text = fbx_of(rig)
        start, end = text.index("AnimationStack:"), text.index("\n}\nConnections")
        path.write_text((text[:start] + text[end:]).replace('C: "OO",3,2\n', ""))
    (tmp_path / "walk.bvh").write_text(bvh_of(walk))
    config = RetargetConfig(contacts=False, clear=False)
    made, _ = retarget(read_clip(tmp_path / "walk.bvh"), read_skeleton(path), config=config)
    out = tmp_path / f"out.{'bvh' if suffix == 'fbx' else suffix}"
    write_clip(made, out)
    back = read_clip(out)
    got = back.positions()[:, [back.skeleton.index(n) for n in walk.names]]
    want = walk.world()
    assert got.shape == want.shape
    # Feet lie on the ground as they can, so the balls do not tell.
    legs = [k for k, n in enumerate(walk.names) if "ball" not in n]
    got, want = got[:, legs], want[:, legs]
    # Seen from the pelvis; how far steps go is a matter of the ground.
    assert np.abs((got - got[:, :1]) - (want - want[:, :1])).max() < 1e-3
    assert np.ptp(got[:, 0, 1]) == pytest.approx(np.ptp(want[:, 0, 1]), rel=0.1)
