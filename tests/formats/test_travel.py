"""Bodies that move below a root with other children: exact places, what is said, and the way back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from handmade_rigs import FPS, Rig, bvh_of, fbx_of, gltf_of, skeleton_of, usda_of, walker

from poise.formats import read_clip, write_clip
from poise.motion import Clip
from poise.motion.clip import trim

FORMATS = ("bvh", "glb", "usda", "fbx")


def put(folder: Path, rig: Rig, suffix: str) -> Path:
    if suffix == "usda":
        pytest.importorskip("pxr")
    if suffix == "fbx":
        pytest.importorskip("ufbx")
    path = folder / f"a.{suffix}"
    if suffix == "glb":
        path.write_bytes(gltf_of(rig).glb())
    else:
        made = {"bvh": bvh_of, "usda": lambda r: usda_of(skeleton_of(r)), "fbx": fbx_of}[suffix]
        path.write_text(made(rig))
    return path


def check(clip: Clip, rig: Rig, *names: str, within: float = 1e-4) -> None:
    """Whether joints, by default those of a person, stand where they should."""
    names = names or walker().names
    assert (clip.frames, round(clip.fps, 3)) == (rig.frames, FPS)
    got = clip.positions()[:, [clip.skeleton.index(n) for n in names]]
    want = rig.world()[:, [rig.index(n) for n in names]]
    assert np.abs(got - want).max() < within


def still_root() -> Rig:
    """Unreal's: a still root with the travelling pelvis, targets that move and targets that do not."""
    rig = walker().below(("root", (0, 0, 0)))
    t = np.arange(rig.frames)[:, None] / FPS
    rig = rig.with_joint("ik_foot_root", "root", (0, 0, 0))
    rig = rig.with_joint("ik_foot_l", "ik_foot_root", (0.09, 0.05, 0) + t * (0, 0, 1.1))
    rig = rig.with_joint("ik_foot_r", "ik_foot_root", (-0.09, 0.05, 0))
    rig = rig.with_joint("ik_hand_root", "root", (0, 0, 0))
    rig = rig.with_joint("ik_hand_gun", "ik_hand_root", (0.4, 1.0, 0.1))
    return rig.with_joint("ik_hand_l", "ik_hand_gun", (0, 0, 0.2))


def moving_root() -> Rig:
    """Root motion on the floor that turns, a pelvis that crouches below it, a prop and a camera."""
    rig = walker(speed=0.0).below(("root", (0, 0, 0)))
    t = np.arange(rig.frames)[:, None] / FPS
    from scipy.spatial.transform import Rotation

    rig = rig.moved("root", t * (0.2, 0, 1.0)).turned(
        "root", Rotation.from_rotvec(np.radians(40) * t * (0, 1, 0))
    )
    rig = rig.moved("pelvis", (0.01, 0.95, -0.02) + 0.3 * np.sin(np.pi * t) * (0, -1, 0))
    rig = rig.with_joint("camera", "root", (0, 1.5, -3))
    return rig.with_joint("prop", "root", (0.5, 0, 0)).with_joint("prop_tip", "prop", (0, 1.2, 0))


def three_levels() -> Rig:
    """A root that travels, a motion bone below it that rises, a pelvis that sways, each with a prop."""
    rig = walker(speed=0.0).below(("root", (0, 0, 0)), ("motion", (0, 0.1, 0)))
    t = np.arange(rig.frames)[:, None] / FPS
    rig = rig.moved("root", t * (0, 0, 1.0)).moved("motion", (0, 0.1, 0) + 0.2 * t * (0, 1, 0))
    rig = rig.moved("pelvis", (0.05 * np.sin(6 * t)) * (1, 0, 0) + (0, 0.85, 0))
    return rig.with_joint("sword", "root", (1, 0, 0)).with_joint("shield", "motion", (-1, 0, 0))


RIGS = {"still": still_root, "moving": moving_root, "levels": three_levels}


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("made", RIGS)
def test_a_body_stands_where_the_file_has_it(tmp_path: Path, suffix: str, made: str) -> None:
    rig = RIGS[made]()
    clip = read_clip(put(tmp_path, rig, suffix))
    check(clip, rig)
    assert clip.skeleton.source.travel_joint == "pelvis"
    if suffix == "fbx":
        return
    # Written and read again, cut or not, it is the same, and in its own format the others stand too.
    write_clip(clip, tmp_path / f"b.{suffix}")
    again = read_clip(tmp_path / f"b.{suffix}")
    assert again.skeleton.names == clip.skeleton.names
    check(again, rig)
    assert np.abs(again.positions() - clip.positions()).max() < 1e-4
    write_clip(trim(clip, 5, 20), tmp_path / f"c.{suffix}")
    assert (
        np.abs(read_clip(tmp_path / f"c.{suffix}").positions()[:, 1] - clip.positions()[5:20, 1]).max()
        < 1e-4
    )
    for other in {"bvh", "glb"} - {suffix}:
        write_clip(clip, tmp_path / f"d.{other}")
        check(read_clip(tmp_path / f"d.{other}"), rig)
