"""Feet and hands planted half a turn away come back; what can be reached stays."""

from __future__ import annotations

import math

import numpy as np
import pytest

from poise.body import find_anatomy, generate_table
from poise.formats import read_clip
from poise.kinematics import clean_clip, clip_to_qpos, fit_humanoid, qpos_to_clip
from poise.kinematics.repair.speeds import TRUNK_SPEED
from poise.kinematics.repair.turns import Flip, neutral_pose, unflip
from poise.motion import Clip
from poise.motion.rotations import quat_angle, quat_conj, quat_mul, rotvec_to_quat
from poise.motion.smoothing import find_runs
from poise.motion.vectors import norm
from toy_human import human, swing

ANATOMY = find_anatomy(human())
FOOT = human().index("LeftFoot")
AXES = {"long": (0.93, 0.0, -0.36), "across": (0, 1.0, 0), "slanted": (0.6, 0.48, 0.64)}


def length(found: Flip) -> int:
    """How many frames were turned back."""
    return found.stop - found.start + 1


def flipped(clip: Clip, joint: int, start: int, stop: int, axis: tuple, angle: float = math.pi) -> Clip:
    """The clip with a joint turned about an axis of its own in frames `start` to `stop - 1`."""
    unit = np.asarray(axis, dtype=float)
    rot = clip.rot.copy()
    half = rotvec_to_quat(angle * unit / norm(unit))
    rot[start:stop, joint] = quat_mul(rot[start:stop, joint], np.broadcast_to(half, (stop - start, 4)))
    return clip.replaced(rot=rot)


def apart_deg(a: Clip, b: Clip) -> float:
    gap = quat_angle(quat_mul(quat_conj(a.rot), b.rot))
    return math.degrees(float(gap.max()))


@pytest.fixture(scope="module")
def walk() -> Clip:
    from importlib.resources import as_file, files

    with as_file(files("poise") / "data/walk.bvh") as path:
        return read_clip(path)


@pytest.fixture(scope="module")
def clip() -> Clip:
    return swing(1.0, 60.0, speed=1.0)


def test_clean_clips_come_back_as_they_are(clip, walk):
    for clean in (clip, walk):
        same, report = clean_clip(clean)
        assert same is clean and not report and report.sentences() == []
        assert report.to_dict() == {"flips": (), "speeds": (), "left": (), "kept": (), "noise": ()}


@pytest.mark.parametrize("axis", AXES.values(), ids=AXES)
@pytest.mark.parametrize(("start", "stop"), [(20, 25), (20, 50), (0, 40), (30, 61), (6, 61)])
def test_a_flipped_foot_comes_back(clip, axis, start, stop):
    fixed, (found,) = unflip(flipped(clip, FOOT, start, stop, axis), ANATOMY, TRUNK_SPEED)
    assert (found.joint, found.start, found.stop) == ("LeftFoot", start, stop - 1)
    assert apart_deg(fixed, clip) < 2.0
    assert found.angle_deg == pytest.approx(180.0, abs=2.0)
    assert found.before_deg > 120 and found.after_deg < 60


@pytest.mark.parametrize("name", ["LeftFoot", "RightFoot"])
@pytest.mark.parametrize("axis", AXES.values(), ids=AXES)
def test_a_flipped_foot_of_a_walk_comes_back(walk, name, axis):
    foot = walk.skeleton.index(name)
    broken = flipped(walk, foot, walk.frames // 4, walk.frames // 2, axis)
    fixed, report = clean_clip(broken)
    assert [f.joint for f in report.flips] == [name] and apart_deg(fixed, walk) < 3.0
    assert length(report.flips[0]) == walk.frames // 2 - walk.frames // 4
    assert any(name in s and "Turned back" in s for s in report.sentences())
    changed = (fixed.rot != broken.rot).any(-1)
    assert not np.delete(changed, foot, 1).any() and not changed[: walk.frames // 4 - 8].any()


def test_a_foot_that_is_flipped_all_the_time_comes_back(clip):
    fixed, (found,) = unflip(flipped(clip, FOOT, 0, clip.frames, AXES["long"]), ANATOMY, TRUNK_SPEED)
    assert length(found) == clip.frames and apart_deg(fixed, clip) < 2.0


def test_an_almost_half_turn_comes_back(clip):
    broken = flipped(clip, FOOT, 20, 50, AXES["slanted"], math.radians(165.0))
    fixed, (found,) = unflip(broken, ANATOMY, TRUNK_SPEED)
    assert found.angle_deg == pytest.approx(165.0, abs=2.0) and apart_deg(fixed, clip) < 2.0


def test_what_a_foot_reaches_and_what_moves_slowly_stays(clip):
    pointed = flipped(clip, FOOT, 20, 50, AXES["across"], math.radians(90.0))
    assert unflip(pointed, ANATOMY, TRUNK_SPEED) == (pointed, ())
    # A turn all the way round within a second is strange, but no jump.
    rot = clip.rot.copy()
    once = np.linspace(0, 2 * math.pi, clip.frames)
    rot[:, FOOT] = quat_mul(rot[:, FOOT], rotvec_to_quat(once[:, None] * np.array([[0, 1.0, 0]])))
    around = clip.replaced(rot=rot)
    assert unflip(around, ANATOMY, TRUNK_SPEED) == (around, ())


def test_a_flipped_hand_comes_back(clip):
    hand = human().index("RightHand")
    fixed, (found,) = unflip(flipped(clip, hand, 10, 30, (0, 0, 1.0)), ANATOMY, TRUNK_SPEED)
    assert found.joint == "RightHand" and apart_deg(fixed, clip) < 2.0
    assert (found.joint, length(found), found.start) == ("RightHand", 20, 10)


def test_a_smeared_flip_is_turned_back_and_its_edges_interpolated(clip):
    whole = flipped(clip, FOOT, 20, 50, AXES["long"])
    for frame, angle in ((19, 1.2), (50, 2.2)):
        whole = flipped(whole, FOOT, frame, frame + 1, AXES["long"], angle)
    fixed, report = clean_clip(whole)
    assert report.flips and report.speeds and apart_deg(fixed, clip) < 5.0


def test_neutral_is_the_rest_pose_where_it_stands(data_dir):
    assert neutral_pose(swing(), ANATOMY)[1]
    folded = read_clip(data_dir / "other/bandai_bvh/dataset-1_walk_normal_001.bvh")
    mean, stands = neutral_pose(folded, find_anatomy(folded.skeleton))
    assert not stands and np.allclose(norm(mean), np.ones(len(mean), dtype=mean.dtype))


def test_spells():
    bad = np.array([0, 1, 1, 0, 1, 0, 0, 0, 1], dtype=bool)
    assert find_runs(bad, 1) == [(1, 4), (8, 8)] and find_runs(bad, 0) == [(1, 2), (4, 4), (8, 8)]
    assert find_runs(~bad & False, 1) == []


def test_planted_branch_flips_of_the_hinges_vanish(clip):
    table = generate_table(human())
    qpos = clip_to_qpos(clip, table)
    other, start = qpos.copy(), 7
    for row in table.rows:
        if len(row.order) == 3:
            # The same rotation in its other Euler branch, and a whole turn on top.
            a = other[20:40, start : start + 3]
            a[:] = np.stack((a[:, 0] + math.pi, math.pi - a[:, 1], a[:, 2] - math.pi), 1)
        start += len(row.order)
    assert np.abs(np.diff(other[:, 7:], axis=0)).max() > 3.0
    broken = qpos_to_clip(other, table, clip.skeleton, clip.fps, clip)
    _, (mended,), report = fit_humanoid(broken, None, 60.0)
    np.testing.assert_allclose(mended, fit_humanoid(clip, None, 60.0)[1][0], atol=1e-6)
    assert not report.clips[0].clean and np.abs(np.diff(mended[:, 7:], axis=0)).max() < 0.1


@pytest.mark.parametrize(("take", "foot", "least"), [("01", "rFoot", 90), ("02", "lFoot", 60)])
def test_flipped_feet_of_another_skeleton_are_turned_back(data_dir, take, foot, least):
    _, report = clean_clip(read_clip(data_dir / f"cmu_bvh/acrnn_salsa/{take}.bvh"))
    assert sum(length(f) for f in report.flips if f.joint == foot) >= least
    assert all(f.after_deg < 60 for f in report.flips) and not report.left


@pytest.mark.parametrize(
    ("clip_name", "foot", "least"), [("90_11", "rfoot", 165), ("05_06", "lfoot", 600)]
)
def test_the_feet_of_real_clips_are_turned_back(data_dir, clip_name, foot, least):
    folder = data_dir / "cmu_amc/rfc"
    clip = read_clip(folder / f"{clip_name}.amc", skeleton=folder / "08.asf")
    fixed, report = clean_clip(clip)
    assert sum(length(f) for f in report.flips if f.joint == foot) >= least
    away = quat_angle(fixed.rot[:, clip.skeleton.index(foot)])
    assert math.degrees(float(away.max())) < 120.0


@pytest.mark.parametrize(
    "name",
    [
        *("other/bandai_bvh/dataset-1_run_active_001.bvh", "cmu_amc/02/02_01.amc"),
        *("lafan1_bvh/walk4_subject1.bvh", "deepmimic_txt/humanoid3d_spinkick.txt"),
        *("deepmimic_txt/humanoid3d_backflip.txt", "cmu_bvh/ad/jumping_jacks.bvh"),
    ],
)
def test_clean_captures_come_back_as_they_are(data_dir, name):
    clip = read_clip(data_dir / name)
    same, report = clean_clip(clip)
    assert same is clip and not report
