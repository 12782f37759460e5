"""The parts of the motion doctor, each by hand-made numbers."""

from __future__ import annotations

import math
from dataclasses import replace
from importlib.resources import as_file, files

import numpy as np
import pytest
from planted_faults import exchanged, lifted

from poise.body import Anatomy
from poise.formats import read_clip
from poise.kinematics import anatomy_of, examine, find_guesses, fit_humanoid, grounded, heal, support_of
from poise.kinematics.hold import mend_slides
from poise.kinematics.repair.faults import KINDS, Fault, by_kind, spell_faults
from poise.kinematics.repair.motion_doctor import Examination, limit_faults, new_faults
from poise.kinematics.repair.speeds import trembling
from poise.kinematics.repair.support import foot_slips, slide_faults
from poise.kinematics.repair.timing import find_gaps, find_holds, mend_teleports
from poise.kinematics.repair.turns import side_votes
from poise.motion import Channel, Clip, Skeleton, Source
from poise.motion.rotations import quat_mul, quat_rotate_inv, rotvec_to_quat
from refusals import refused
from toy_human import human, swing


@pytest.fixture(scope="module")
def walk() -> Clip:
    with as_file(files("poise") / "data/walk.bvh") as path:
        return read_clip(path)


def test_spells_become_faults_with_their_largest_size() -> None:
    size = np.array([0, 3, 5, 0, 2, 0, 0, 0, 9.0])
    faults = spell_faults("speed", "a", size, size > 0, 1)
    assert [(f.start, f.stop, f.size) for f in faults] == [(1, 4, 5.0), (8, 8, 9.0)]
    assert [f.start for f in spell_faults("speed", "a", size, size > 0, 1, least=2)] == [1]


def test_kinds_come_in_their_order_and_know_their_unit() -> None:
    faults = [Fault("float", "", 0, 1, 2.0), Fault("teleport", "hip", 3, 3, 0.5)]
    assert list(by_kind(faults)) == ["teleport", "float"]
    assert faults[1].to_dict()["unit"] == "m" and faults[1].repairable
    assert not Fault("limit", "a", 0, 1, 50.0).repairable
    assert all(kind.title for kind in KINDS.values())


@pytest.mark.parametrize("fps", [30.0, 120.0])
def test_noise_has_its_own_size_and_motion_has_none(fps: float) -> None:
    rng = np.random.default_rng(1)
    t = np.arange(400) / fps
    motion = 0.1 * np.stack((np.sin(9.0 * t), np.cos(7.0 * t), t), -1).astype(float)
    assert not trembling(motion, fps, 1e-6)[1].any()
    noisy = motion + rng.normal(0.0, 0.01, (400, 3))
    size, bad = trembling(noisy, fps, 0.003)
    assert bad.mean() > 0.95
    # Three axes of deviation s give vectors of about 1.5 s in the median.
    assert np.median(size) == pytest.approx(0.0155, rel=0.15)
    # A single spike is no noise.
    spike = motion.copy()
    spike[200] += 0.2
    assert not trembling(spike, fps, 0.003)[1].any()


def test_a_still_body_is_not_frozen_and_repeats_are_told_apart() -> None:
    clip = swing(1.0, 60.0)
    still = clip.replaced(root_pos=clip.root_pos[[0] * 30], rot=clip.rot[[0] * 30])
    assert find_holds(still) == [] and find_holds(clip) == [] and find_gaps(clip) == []


def test_a_path_without_jumps_is_returned_as_it_is(walk: Clip) -> None:
    assert mend_teleports(walk) is walk


def test_a_standing_foot_does_not_slip_and_a_locked_one_stays(walk: Clip) -> None:
    push = np.linspace(0.0, 0.6, walk.frames)[:, None] * np.array([0.0, 1.0, 0.0])
    broken = walk.replaced(root_pos=walk.root_pos + push)
    support = support_of(broken, anatomy_of(broken))
    assert support is not None
    faults = slide_faults(broken, support)
    assert faults
    locked = mend_slides(broken, support, faults)
    after = support_of(locked, anatomy_of(locked))
    assert after is not None
    for (_, slip, held), (_, less, now) in zip(foot_slips(support), foot_slips(after), strict=True):
        before, behind = np.linalg.norm(slip[held], axis=-1), np.linalg.norm(less[now], axis=-1)
        assert np.median(behind) < 0.5 * np.median(before)
    # Only legs move; feet turn about the vertical alone.
    legs = [j for j, n in enumerate(walk.skeleton.names) if any(w in n for w in ("Leg", "Foot"))]
    others = [j for j in range(len(walk.skeleton)) if j not in legs]
    np.testing.assert_array_equal(locked.rot[:, others], broken.rot[:, others])
    foot = walk.skeleton.index("LeftFoot")
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0], dtype=float), (walk.frames, 3))
    tilts = [quat_rotate_inv(c.world()[1][:, foot], up) for c in (locked, broken)]
    np.testing.assert_allclose(*tilts, atol=1e-9, rtol=0)
    lengths = [
        np.linalg.norm(np.diff(c.positions()[:, [1, 2, 3]], axis=1), axis=-1) for c in (walk, locked)
    ]
    np.testing.assert_allclose(*lengths, atol=1e-9)


def test_sides_are_told_by_feet_knees_and_travel(walk: Clip) -> None:
    votes = side_votes(walk, anatomy_of(walk))
    assert set(votes) == {"feet", "knees", "travel"} and min(votes.values()) > 0.9
    other = exchanged(walk)
    assert max(side_votes(other, anatomy_of(other)).values()) < -0.9
    # Lying on the back changes nothing: the trunk tells what is up.
    turn = rotvec_to_quat(np.array([0.0, math.pi / 2, 0.0], dtype=float))
    rot = walk.rot.copy()
    rot[:, 0] = quat_mul(np.broadcast_to(turn, (walk.frames, 4)), rot[:, 0])
    lying = walk.replaced(rot=rot)
    assert min(v for k, v in side_votes(lying, anatomy_of(lying)).items() if k != "travel") > 0.9


def test_limits_of_the_file_are_those_of_its_own_angles() -> None:
    degrees = math.radians(1.0)
    channels = (
        Channel(("TX", "TY", "TZ", "rx", "ry", "rz")),
        Channel(("rx",), (0.0, 0.0, 0.0), "XYZ", ((-10 * degrees, 20 * degrees),)),
    )
    source = Source(format="asf-amc", up_axis="Z", channels=channels)
    skeleton = Skeleton(("root", "knee"), (-1, 0), np.array([[0, 0, 0], [0, 0, 1.0]]), (), source)
    angle = np.zeros((60, 3))
    angle[20:40, 0] = 90 * degrees
    rot = np.zeros((60, 2, 4))
    rot[..., 0] = 1.0
    rot[:, 1] = rotvec_to_quat(angle)
    (fault,) = limit_faults(Clip(skeleton, np.zeros((60, 3)), rot, 30.0))
    assert (fault.joint, fault.start, fault.stop) == ("knee", 20, 39)
    assert fault.size == pytest.approx(70.0, abs=1e-6)


def test_what_reading_mended_is_told(walk: Clip) -> None:
    clip = walk
    mended = (("bone drift", "Head", 0, -1, 0.05), ("quaternion length", "Hips", 3, 9, 0.1))
    told = clip.replaced(skeleton=clip.skeleton.with_source(mended=mended))
    faults = {f.kind: f for f in examine(told).faults}
    assert faults["bone drift"].stop == clip.frames - 1 and faults["bone drift"].size == 50.0
    assert (faults["quaternion length"].start, faults["quaternion length"].size) == (3, 0.1)
    assert heal(told) is told


def test_joints_without_a_body_are_examined_as_far_as_they_can_be() -> None:
    skeleton = Skeleton(("a", "b"), (-1, 0), np.array([[0, 0, 0], [0, 0, 1.0]]))
    rot = np.tile([1.0, 0, 0, 0], (40, 2, 1))
    path = np.zeros((40, 3))
    path[:, 0] = np.arange(40) / 60.0
    path[20:, 0] += 2.0
    clip = Clip(skeleton, path, rot, 60.0)
    seen = examine(clip)
    assert not seen.judged and [f.kind for f in seen.faults] == ["teleport"]
    assert seen.figures["sole_slide_mm_per_s"] is None
    assert examine(heal(clip)).faults == ()
    assert anatomy_of(clip) == Anatomy((), ())
    values = {g.what: g.value for g in find_guesses(clip)}
    assert values["sides"] is None and values["feet"] is None and values["ground"] is None
    with refused("floor-unknown"):
        grounded(clip, None, None)


def test_a_tip_that_no_hand_has_is_not_believed(walk: Clip) -> None:
    s = walk.skeleton
    hand = anatomy_of(walk).of("hand")[0]
    ends = (*((j, tip) for j, tip in s.ends if j != hand), (hand, (0.0, -3.0, 0.0)))
    odd = walk.replaced(skeleton=replace(s, ends=ends))
    assert (hand, (0.0, -3.0, 0.0)) not in odd.skeleton.tips and len(odd.skeleton.tips) > 2
    assert not [f for f in examine(odd).faults if f.kind == "penetration"]


def test_a_stated_floor_is_believed_by_the_body() -> None:
    clip = lifted(swing(1.0, 60.0), 0.2)
    _, free, _ = fit_humanoid(clip)
    known = grounded(clip, None, 0.17)
    assert known.skeleton.source.ground_m == 0.17
    _, held, report = fit_humanoid(known)
    assert report.clips[0].ground.lift_m == 0.0
    # Without it the soles decide, and they stand 20 cm up.
    assert free[0][:, 2].mean() < clip.root_pos[:, 2].mean() - 0.1
    assert abs(held[0][:, 2].mean() - known.root_pos[:, 2].mean()) < 0.04


@pytest.mark.parametrize("frames", [2, 3, 5, 9])
def test_short_clips_are_no_problem(frames: int) -> None:
    clip = swing(1.0, 60.0)
    short = clip.replaced(root_pos=clip.root_pos[:frames], rot=clip.rot[:frames])
    assert isinstance(examine(short).to_dict()["faults"], list)
    assert heal(short).frames == frames
    assert len(human()) == len(short.skeleton)


def test_only_what_is_new_is_told() -> None:
    old = Examination((Fault("foot slide", "a", 0, 5, 4.0), Fault("limit", "a", 0, 5, 4.0)), {}, True)
    more = (
        Fault("joint jump", "knee", 7, 9, 46.6), Fault("foot slide", "a", 0, 5, 5.0),
        Fault("foot slide", "b", 8, 9, 7.7), Fault("limit", "b", 0, 5, 9.0),
        Fault("limit", "c", 0, 5, 9.0),
    )  # fmt: skip
    assert new_faults("x", old, old) == []
    (told,) = new_faults("x", old, Examination(more, {}, True))
    assert "1 more of 'foot slide' (the worst 7.7 cm, b 8-9)" in told
    assert "1 of 'joint jump' (the worst 46.6 rad/s, knee 7-9)" in told and "limit" not in told
