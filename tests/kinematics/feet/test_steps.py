"""Steps that a transition lacks, and feet that swing clear of the floor."""

from __future__ import annotations

import numpy as np

from poise.kinematics.steps import CLEAR_M, LEAST_M, lock_feet, missing_steps, rises
from poise.motion.rotations import forward_kinematics
from poise.motion.vectors import norm
from poise.synthesis.windows import foot_joints
from toy_human import swing, turn

FPS = 30.0


def sliding(frames: int, *far: float, at: float = 0.5) -> np.ndarray:
    """Soles `(T, K, 2, 3)` of feet that slide `far` m forward on the floor, most of it about `at`."""
    t = np.linspace(0, 1, frames)
    way = 1 / (1 + np.exp(-12 * (t - at)))
    way = (way - way[0]) / (way[-1] - way[0])
    soles = np.zeros((frames, len(far), 2, 3))
    soles[:, :, 1, 0] = 0.15
    soles[..., 0] += (way[:, None] * np.asarray(far, dtype=float))[..., None]
    return soles


def standing(frames: int, feet: int) -> np.ndarray:
    return np.ones((frames, feet), dtype=bool)


def test_a_foot_that_is_elsewhere_at_the_end_steps_when_it_is_moved() -> None:
    early, late = (
        missing_steps(sliding(32, 0.4, 0.0, at=at), standing(32, 2), FPS) for at in (0.3, 0.7)
    )
    assert [s.foot for s in (*early, *late)] == [0, 0]
    # 0.3 s and 0.15 s for every metre.
    assert early[0].stop - early[0].start == round(0.36 * FPS)
    assert abs(0.5 * (early[0].start + early[0].stop) - 0.3 * 31) < 2
    assert abs(0.5 * (late[0].start + late[0].stop) - 0.7 * 31) < 2


def test_two_feet_step_one_after_the_other() -> None:
    first, second = missing_steps(sliding(32, 0.6, 0.7), standing(32, 2), FPS)
    assert {first.foot, second.foot} == {0, 1}
    assert first.stop <= second.start and first.start >= 1 and second.stop <= 31


def test_a_step_waits_for_the_other_foot() -> None:
    stands = standing(40, 2)
    stands[14:26, 1] = False
    (step,) = missing_steps(sliding(40, 0.4, 0.0), stands, FPS)
    assert step.foot == 0 and (step.stop <= 14 or step.start >= 26)


def test_shuffles_turns_and_feet_that_swing_anyway_need_no_step() -> None:
    assert missing_steps(sliding(32, 0.9 * LEAST_M, 0.0), standing(32, 2), FPS) == ()
    # The toes stay while the heel turns out.
    turning = sliding(32, 0.3)
    turning[:, :, 1] = turning[:1, :, 1]
    assert missing_steps(turning, standing(32, 1), FPS) == ()
    swings = standing(32, 1)
    swings[10:20] = False
    assert missing_steps(sliding(32, 0.4), swings, FPS) == ()
    # There is no time for it.
    assert missing_steps(sliding(4, 0.4), standing(4, 1), FPS) == ()


def test_feet_that_drag_are_raised_and_others_left() -> None:
    stands = standing(32, 2)
    stands[10:22] = False
    soles = sliding(32, 0.4, 0.02)
    up = rises(soles, stands)
    assert np.array_equal(up[:10], np.zeros((10, 2)).astype(float)) and not up[22:].any()
    # Foot 1 hardly moves. Foot 0 is clear by what is asked for in the middle of its swing.
    assert not up[:, 1].any() and float(up[:, 0].max()) > 0.9 * CLEAR_M
    assert float(np.abs(np.diff(up[:, 0], n=2)).max()) < 0.2 * CLEAR_M
    high = soles.copy()
    high[10:22, 0, :, 2] = 0.1
    assert not rises(high, stands).any()
    # Half as high: raised by what is missing alone.
    high[10:22, 0, :, 2] = 0.5 * CLEAR_M
    assert 0 < float(rises(high, stands).max()) < 0.7 * CLEAR_M


def test_kept_feet_that_are_apart_step_instead_of_sliding() -> None:
    clip = swing(1.0, speed=0.3)
    skeleton, (root, rot) = clip.skeleton, clip.arrays()
    for side in ("Left", "Right"):
        rot[:, skeleton.index(f"{side}UpLeg")] = turn("Y", np.full((31,), -0.4).astype(float))
        rot[:, skeleton.index(f"{side}Leg")] = turn("Y", np.full((31,), 0.8).astype(float))
    root[:, 2] -= 0.02
    feet, offsets = foot_joints(skeleton), skeleton.offsets.copy()
    free = np.ones(31, dtype=bool)
    free[[0, 30]] = False
    held = lock_feet(skeleton, feet, root, rot, np.ones((31, 4), dtype=bool), free, FPS)
    before, after = (forward_kinematics(skeleton.parents, offsets, root, r)[0] for r in (rot, held))
    assert np.array_equal(held[0], rot[0]) and np.array_equal(held[30], rot[30])
    low, moving = [], []
    for toe in (feet[1], feet[3]):
        height = after[:, toe, 2] - before[:, toe, 2].min()
        speed = norm(np.diff(after[:, toe, :2], axis=0)) * FPS
        low.append(float(speed[(height[1:] < 0.01) & (height[:-1] < 0.01)].mean()))
        moving.append(height > 0.02)
    # The body goes at 0.3 m/s, and so would feet that slide.
    assert max(low) < 0.1
    assert not (moving[0] & moving[1]).any() and moving[0].any() and moving[1].any()
