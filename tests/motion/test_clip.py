"""Clips and skeletons: frozen, checked when made, their world positions by hand; libraries of clips:
sampling by time, weights, one hierarchy."""

from __future__ import annotations

import math
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
import torch

from poise.errors import PoiseError
from poise.motion import Clip, ClipLibrary, Skeleton
from poise.motion.rotations import euler_to_quat
from refusals import refused
from toy_human import human, swing


def arm() -> Skeleton:
    return Skeleton(("root", "upper", "lower"), (-1, 0, 1), np.array([[0, 0, 0], [0, 0, 1], [2, 0, 0]]))


def still(frames: int = 3) -> Clip:
    rot = np.zeros((frames, 3, 4))
    rot[..., 0] = 1.0
    return Clip(arm(), np.zeros((frames, 3)), rot, 30.0, "still")


def test_world_positions_by_hand():
    clip = still()
    rot = clip.rot.copy()
    rot[1, 1] = euler_to_quat(torch.tensor([math.pi / 2], dtype=torch.float64), "Z").numpy()
    moved = clip.replaced(rot=rot, root_pos=clip.root_pos + np.array([0, 0, 0.5]))
    pos, quat = moved.world()
    np.testing.assert_allclose(pos[0], [[0, 0, 0.5], [0, 0, 1.5], [2, 0, 1.5]], atol=1e-12)
    np.testing.assert_allclose(pos[1], [[0, 0, 0.5], [0, 0, 1.5], [0, 2, 1.5]], atol=1e-12)
    np.testing.assert_allclose(quat[1, 2], rot[1, 1], atol=1e-12)
    np.testing.assert_array_equal(moved.positions(), pos)
    assert moved.frames == 3 and moved.seconds == pytest.approx(2 / 30)


def test_a_clip_cannot_be_changed():
    source = np.zeros((3, 3))
    clip = still().replaced(root_pos=source)
    source[0] = 9.0
    assert not clip.root_pos.any(), "The clip keeps a copy."
    for array in (clip.root_pos, clip.rot, clip.skeleton.offsets):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    with pytest.raises(FrozenInstanceError):
        clip.fps = 60.0  # type: ignore[misc]
    pos, rot = clip.tensors()
    pos += 1
    rot += 1
    assert not clip.root_pos.any() and clip.rot[0, 0].tolist() == [1, 0, 0, 0]
    assert clip.tensors(torch.float32)[0].dtype == torch.float32


def broken(**changes: object) -> str:
    with pytest.raises(PoiseError) as error:
        still().replaced(**changes)
    return str(error.value)


def test_faults_are_told_with_joint_and_frame():
    rot, pos = still().rot.copy(), still().root_pos.copy()
    rot[2, 1] = [2.0, 0, 0, 0]
    assert "still: the rotation of joint 'upper' at frame 2 is not a unit quaternion (norm 2)" in broken(
        rot=rot
    )
    rot[2, 1] = np.nan
    assert "joint 'upper' at frame 2" in broken(rot=rot)
    pos[1, 2] = np.inf
    assert broken(root_pos=pos) == "still: the root position is not finite at frame 1"
    assert "got (3, 2) and (3, 3, 4)" in broken(root_pos=np.zeros((3, 2)))
    assert "got (4, 3) and (3, 3, 4)" in broken(root_pos=np.zeros((4, 3)))
    for fps in (0.0, -30.0, math.nan, math.inf, 1e-3, 2001.0, 1e300):
        assert "frame rate must be from 0.1 to 2000 per second, got" in broken(fps=fps)
    with refused("clip-too-short", says="1"):
        still(1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"names": ("a", "b", "a")}, ("name-repeated", "a")),
        ({"parents": (-1, 0)}, ("count-differs", ("3", "2"))),
        ({"parents": (0, 0, 1)}, ("parent-order", ("root", "0"))),
        ({"parents": (-1, 2, 0)}, ("parent-order", ("upper", "2"))),
        ({"parents": (-1, -1, 0)}, ("parent-order", ("upper", "-1"))),
        ({"offsets": np.full((3, 3), np.nan)}, ("not-finite", "root")),
        ({"offsets": np.zeros((3, 2))}, ("count-differs", "3, 2")),
    ],
)
def test_skeletons_are_checked(changes, message):
    with refused(*message):
        replace(arm(), **changes)


def test_an_empty_skeleton_is_refused():
    with refused("no-joints"):
        Skeleton((), (), np.zeros((0, 3)))


def test_skeletons_answer():
    skeleton = replace(arm(), ends=((2, (0.0, 0.0, 0.5)),))
    assert skeleton.index("lower") == 2 and skeleton.children(0) == (1,) and len(skeleton) == 3
    np.testing.assert_array_equal(skeleton.rest_positions(), [[0, 0, 0], [0, 0, 1], [2, 0, 1]])
    with refused("unknown-joint", says=("lowr", "lower")):
        skeleton.index("lowr")


def test_skeletons_are_equal_by_content():
    assert arm() == arm() and hash(arm()) == hash(arm())
    longer = replace(arm(), offsets=arm().offsets * 2)
    assert longer != arm() and arm().with_source(format="bvh") != arm()
    assert arm().with_source(format="bvh").source.format == "bvh" and arm() != "arm"


def test_one_clip_is_a_library_of_one():
    library = ClipLibrary.of(swing())
    assert len(library) == 1 and library.names == ("swing",) and library.seconds == pytest.approx(1.0)
    assert [c.name for c in library] == ["swing"]


def test_sampling_follows_duration_and_stays_inside():
    library = ClipLibrary.of([swing(3.0), swing(1.0, name="short")])
    which, time = library.sample(20_000, np.random.default_rng(0))
    assert np.mean(which == 0) == pytest.approx(0.75, abs=0.01)
    assert time.min() >= 0 and time[which == 1].max() <= 1.0 < time[which == 0].max() <= 3.0
    # Uniform in the clip: mean and spread of a uniform number.
    long = time[which == 0] / 3.0
    assert long.mean() == pytest.approx(0.5, abs=0.01) and long.std() == pytest.approx(
        12**-0.5, abs=0.01
    )


def test_the_same_seed_draws_the_same():
    library = ClipLibrary.of([swing(1.0), swing(2.0, name="b")])
    a, b, c = (library.sample(50, np.random.default_rng(s)) for s in (1, 1, 2))
    assert np.array_equal(a[0], b[0]) and np.array_equal(a[1], b[1])
    assert not np.array_equal(a[1], c[1])


def test_weights_rule_where_stated():
    library = ClipLibrary((swing(3.0), swing(1.0, name="b")), (0.0, 2.0))
    assert set(library.sample(100, np.random.default_rng(0))[0]) == {1}


def test_bone_lengths_may_differ_but_hierarchies_not():
    ClipLibrary((swing(), swing(scale=1.2, name="tall")))
    skeleton = human()
    renamed = replace(skeleton, names=("pelvis", *skeleton.names[1:]))
    with refused("skeleton-differs", says=("odd", "swing")):
        ClipLibrary((swing(), swing(name="odd").replaced(skeleton=renamed)))
    with refused("no-clips"):
        ClipLibrary(())


@pytest.mark.parametrize("weights", [(1.0,), (1.0, -1.0), (0.0, 0.0), (1.0, 1.0, 1.0)])
def test_wrong_weights_are_told(weights):
    with refused("bad-weights", says="2"):
        ClipLibrary((swing(), swing(name="b")), weights)
