"""Bodies of several skins, animations in parts, stills, rigs without animation, two people: glTF."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from handmade_gltf_files import Gltf
from handmade_rigs import FPS, Rig, gltf_of, walker

from poise.formats import read_clip
from poise.formats.table import read_skeleton
from poise.motion import Clip
from refusals import refused

LEGS_L = ("thigh_l", "calf_l", "foot_l", "ball_l")
LEGS_R = ("thigh_r", "calf_r", "foot_r", "ball_r")
TRUNK = ("pelvis", "spine", "neck", "head")
ARMS = ("upperarm_l", "forearm_l", "hand_l", "upperarm_r", "forearm_r", "hand_r")


def read(folder: Path, file: Gltf, **options: str) -> Clip:
    path = folder / "a.glb"
    path.write_bytes(file.glb())
    return read_clip(path, **options)


def check(clip: Clip, rig: Rig, frames: int | None = None) -> None:
    """Whether all joints of the rig are there and stand where they should."""
    assert set(clip.skeleton.names) >= set(rig.names)
    got = clip.positions()[:, [clip.skeleton.index(n) for n in rig.names]]
    want = rig.world()[:frames]
    assert got.shape == want.shape and np.abs(got - want).max() < 1e-4


@pytest.mark.parametrize(
    "skins",
    [
        (LEGS_L, LEGS_R, (*TRUNK, *ARMS)),  # Legs hang on a joint of the trunk and share none.
        ((*LEGS_L, "calf_r"), ("spine", *ARMS), ("pelvis", "thigh_l"), ("head", "spine"), LEGS_R),
        (("neck", "head"), LEGS_R, ARMS, LEGS_L),  # The pelvis and the spine have no skin.
        (("ball_l",), LEGS_L[:3], (*LEGS_R, "pelvis"), ("spine", "neck", "head", *ARMS)),
        ((*TRUNK, *LEGS_L, *LEGS_R),),  # The arms are animated and have no skin.
    ],
    ids=("beside", "shared", "loose", "feet", "bare arms"),
)  # fmt: skip
@pytest.mark.parametrize("order", [1, -1])
def test_a_body_of_several_skins_keeps_its_limbs(tmp_path: Path, skins: tuple, order: int) -> None:
    rig = walker()
    check(read(tmp_path, gltf_of(rig, skins[::order])), rig)
    aside = rig.moved("pelvis", rig.place[0] + (0.5, 0, 0))
    check(read(tmp_path, gltf_of(rig.below(("Armature", (0.5, 0, 0))), skins[::order])), aside)


def cut(rig: Rig, frames: int) -> Rig:
    """The first frame, again and again."""
    turns = tuple(type(q).from_quat(np.tile(q.as_quat()[:1], (frames, 1))) for q in rig.turn)
    return Rig(rig.names, rig.parents, tuple(np.tile(p[:1], (frames, 1)) for p in rig.place), turns)


def test_two_people_are_one_and_the_other_is_named(tmp_path: Path) -> None:
    a, b = walker(), walker(prefix="B_").moved("B_pelvis", (3, 0.95, 0))
    both = gltf_of(b, [b.names], [b.names], gltf_of(a, [a.names], [a.names]))
    first, second = both.doc["animations"]
    joined = Gltf()
    joined.__dict__.update(both.__dict__)
    shift = len(first["samplers"])
    for channel in second["channels"]:
        channel["sampler"] += shift
    first["samplers"] += second["samplers"]
    first["channels"] += second["channels"]
    joined.doc["animations"] = [first]
    note = (
        "The file holds 2 bodies: 'pelvis' (18 joints) was read, and the other one was left out: "
        "'B_pelvis' (18 joints); to read another, export it alone"
    )
    clip = read(tmp_path, joined)
    check(clip, a)
    assert len(clip.skeleton) == 18 and note in clip.skeleton.source.notes
    # Below one armature, in one skin, or as mere nodes, they are two people still.
    top = joined.node("Armature", None, translation=[0, 0, 0], children=[0, 18])
    joined.doc["scenes"][0]["nodes"] = [top]
    for skins in (joined.doc["skins"], [{"joints": [*range(36)]}], []):
        joined.doc["skins"] = skins
        clip = read(tmp_path, joined)
        check(clip, a)
        assert len(clip.skeleton) == 18 and note in clip.skeleton.source.notes


@pytest.mark.parametrize("order", [1, -1])
def test_animations_of_different_nodes_over_one_span_are_one(tmp_path: Path, order: int) -> None:
    rig = walker()
    clip = read(tmp_path, gltf_of(rig, parts=[(n,) for n in rig.names][::order]))
    check(clip, rig)
    assert "18 animations, from 0 'part 0' on, move different nodes" in clip.skeleton.source.notes[0]
    # By groups of bones.
    check(read(tmp_path, gltf_of(rig, parts=[(*LEGS_L, *LEGS_R), (*TRUNK, *ARMS)][::order])), rig)


def test_takes_of_the_same_nodes_stay_takes(tmp_path: Path) -> None:
    """Two takes of one animation for each bone, of one length, in any order."""
    walk, run = walker(), walker(speed=3.0)
    file = gltf_of(walk, parts=[(n,) for n in walk.names])
    times = np.arange(31) / FPS
    for j, name in enumerate(run.names):
        part = file.animation(f"run_{name}_rotation")
        file.channel(part, j, "rotation", times, run.turn[j].as_quat())
    file.channel(file.animation("run_pelvis_location"), 0, "translation", times, run.place[0])
    for j, part in enumerate(file.doc["animations"][:18]):
        part["name"] = f"walk_{walk.names[j]}_rotation"
    check(read(tmp_path, file), walk)
    check(read(tmp_path, file, take="run_head_rotation"), run)
    # Not all at once, and other spans stay apart.
    file = gltf_of(walk, parts=[walk.names, walk.names])
    clip = read(tmp_path, file)
    check(clip, walk)
    assert clip.skeleton.source.notes[0].startswith("Of 2 animations the longest")


def test_a_still_animation_is_read(tmp_path: Path) -> None:
    rig = walker(speed=0.0)
    still = cut(rig, 31)
    clip = read(tmp_path, gltf_of(still))
    check(clip, still)
    assert clip.frames == 31 and clip.fps == pytest.approx(FPS)
    assert "Nothing moves in it: its 31 frames show one pose" in clip.skeleton.source.notes
    # A single key is two frames of one pose.
    clip = read(tmp_path, gltf_of(cut(rig, 1)))
    assert clip.frames == 2
    np.testing.assert_allclose(clip.positions()[1], still.world()[1], atol=1e-5)


def test_a_rig_without_animation_shows_its_rest_pose(tmp_path: Path) -> None:
    rig = walker()
    file = gltf_of(rig)
    file.doc["animations"] = []
    with refused("no-animation"):
        read(tmp_path, file)
    for skins in (file.doc["skins"], []):
        file.doc["skins"] = skins
        (tmp_path / "a.glb").write_bytes(file.glb())
        clip = read_skeleton(tmp_path / "a.glb")
        assert clip.frames == 2 and set(clip.skeleton.names) == set(rig.names)
        at = [clip.skeleton.index(n) for n in rig.names]
        np.testing.assert_allclose(clip.positions()[0, at], rig.world()[0], atol=1e-5)
