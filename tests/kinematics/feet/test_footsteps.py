"""Feet led from stand to stand: plans of steps, toes that do not move between them."""

from __future__ import annotations

import numpy as np
import pytest

from poise.kinematics.feet import Motion, standing_heights
from poise.kinematics.repair.motion_doctor import examine
from poise.kinematics.steps import planned, stepped
from poise.motion import Clip
from poise.motion.rotations import forward_kinematics
from poise.motion.vectors import norm
from poise.synthesis.limits import excess, fastest
from toy_human import swing

FPS = 30.0
STAND = np.zeros((2, 2), dtype=bool)


def up(at: int, foot: int) -> np.ndarray:
    out = STAND.copy()
    out[at, foot] = True
    return out


def test_as_few_steps_as_there_may_be() -> None:
    assert planned((0.0, 0.03), STAND, 1.0, 0) == ()
    one = planned((0.3, 0.0), STAND, 1.0, 0)
    assert one is not None and [s.foot for s in one] == [0]
    both = planned((0.6, 0.6), STAND, 1.0, 1)
    assert both is not None and [s.foot for s in both] == [1, 0]
    # One after the other, within the gap.
    assert 0.0 <= both[0].start < both[0].stop <= both[1].start < both[1].stop <= 1.0
    far = planned((3.0, 3.0), STAND, 2.0, 0)
    assert far is not None and [s.foot for s in far] == [0, 1, 0, 1]
    more = planned((0.6, 0.6), STAND, 2.0, 0, (1, 1))
    assert more is not None and len(more) == 4
    # The longer step has more of the time.
    uneven = planned((0.4, 1.5), STAND, 1.0, 0)
    assert uneven is not None
    assert uneven[1].stop - uneven[1].start > uneven[0].stop - uneven[0].start


def test_feet_in_the_air_in_a_keyframe_are_under_way() -> None:
    first = planned((0.5, 0.5), up(0, 1), 1.0, 1)
    assert first is not None and first[0].foot == 1 and first[0].start == 0.0
    last = planned((0.5, 0.5), up(1, 0), 1.0, 1)
    assert last is not None and last[-1].foot == 0 and last[-1].stop == pytest.approx(1.0)
    # A plan that begins with the other foot does not fit; two feet in the air are no walk.
    assert planned((0.5, 0.5), up(0, 1), 1.0, 0) is None
    assert planned((0.5, 0.5), np.ones((2, 2), dtype=bool), 1.0, 0) is None
    # No time for so many.
    assert planned((3.0, 3.0), STAND, 0.5, 0) is None


def ahead(metres: float) -> tuple[Clip, Motion]:
    """A figure that stands, and slides ahead with all of its body in a second."""
    clip = swing(1.0)
    root, rot = (np.repeat(x[:1], 31, 0) for x in clip.arrays())
    root = root.copy()
    root[:, 0] += np.linspace(0.0, metres, 31, dtype=root.dtype)
    return clip, (root, rot)


def test_a_figure_that_slides_walks_instead() -> None:
    clip, motion = ahead(0.9)
    skeleton = clip.skeleton
    limits = fastest(skeleton)
    floor = standing_heights(skeleton, (motion[0][[0, -1]], motion[1][[0, -1]]))

    def over(made: Motion) -> float:
        return excess(skeleton, limits, made, FPS)[0]

    made = stepped(skeleton, motion, floor, None, FPS, over)
    assert made is not None and over(made) <= 1.0
    np.testing.assert_allclose(made[1][[0, -1]], motion[1][[0, -1]], atol=1e-7)
    np.testing.assert_allclose(made[0][[0, -1]], motion[0][[0, -1]], atol=1e-7)
    offsets = np.asarray(skeleton.offsets, dtype=float)
    pos = forward_kinematics(skeleton.parents, offsets, *made)[0]
    for name in ("LeftToe", "RightToe"):
        toe = pos[:, skeleton.index(next(n for n in skeleton.names if n.startswith(name)))]
        speed = norm(np.diff(toe, axis=0)[:, :2]) * FPS
        # Still in some frames, on its way in others, and in the air then.
        assert int((speed < 0.02).sum()) > 8 and float(speed.max()) > 1.0
        assert float(toe[int(speed.argmax()), 2] - toe[:, 2].min()) > 0.02
    whole = clip.replaced(root_pos=made[0], rot=made[1])
    slid = clip.replaced(root_pos=motion[0], rot=motion[1])
    assert any(f.kind == "foot slide" for f in examine(slid).faults)
    assert not any(f.kind in ("foot slide", "penetration") for f in examine(whole).faults)
