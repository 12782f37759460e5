"""Impossible turns are mended, and nothing else is touched."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from poise.motion import Clip
from poise.motion.repair import IMPOSSIBLE_SPEED, remove_spikes, spike_sentence
from poise.spatial import quat_angle, quat_conj, quat_mul
from toy_human import human, swing, turn

JOINT = human().index("LeftArm")


def twisted(clip: Clip, angles: np.ndarray, joint: int = JOINT) -> Clip:
    """The clip with a joint turned by `angles (T)` rad about its long axis."""
    rot = torch.tensor(clip.rot)
    rot[:, joint] = quat_mul(rot[:, joint], turn("Z", torch.tensor(angles)))
    return clip.replaced(rot=rot.numpy())


def apart(a: Clip, b: Clip) -> np.ndarray:
    """Angle `(T, J)` rad between the local rotations of two clips."""
    return quat_angle(quat_mul(quat_conj(torch.tensor(a.rot)), torch.tensor(b.rot))).numpy()


@pytest.fixture
def clip() -> Clip:
    return swing(1.0, 120.0, speed=1.0)


@pytest.mark.parametrize("length", [1, 2, 6])
def test_a_brief_flip_is_interpolated_away(clip, length):
    angles = np.zeros(clip.frames)
    angles[50 : 50 + length] = 2.8
    mended, spikes = remove_spikes(twisted(clip, angles))
    (spike,) = spikes
    assert spike.joint == "LeftArm" and spike.peak == pytest.approx(2.8 * 120, rel=0.02)
    # Within the margin of two frames on each side, and close to the motion that was there.
    assert 47 <= spike.start <= 50 and 49 + length <= spike.stop <= 52 + length
    assert apart(mended, clip).max() < 0.02
    assert np.array_equal(mended.root_pos, clip.root_pos) and mended.fps == clip.fps
    assert np.abs(np.linalg.norm(mended.rot, axis=-1) - 1).max() < 1e-12


def test_other_joints_and_frames_are_not_touched(clip):
    angles = np.zeros(clip.frames)
    angles[50:53] = 2.8
    broken = twisted(clip, angles)
    mended, (spike,) = remove_spikes(broken)
    changed = apart(mended, broken) > 1e-7
    others = [j for j in range(len(clip.skeleton)) if j != JOINT]
    assert not changed[:, others].any()
    assert set(np.flatnonzero(changed[:, JOINT])) <= set(range(spike.start, spike.stop + 1))


def test_spikes_of_several_joints_are_told(clip):
    angles, more = np.zeros(clip.frames), np.zeros(clip.frames)
    angles[30:32], angles[80:82], more[60] = 2.0, 2.9, 1.0
    broken = twisted(twisted(clip, angles), more, human().index("Head"))
    mended, spikes = remove_spikes(broken)
    assert sorted(s.joint for s in spikes) == ["Head", "LeftArm", "LeftArm"]
    assert apart(mended, clip).max() < 0.02
    sentence = spike_sentence(spikes)
    assert sentence.startswith("3 brief turns faster than a human joint (up to 348 rad/s; the first at")
    assert f"frame {min(s.start for s in spikes)})" in sentence
    assert "LeftArm" in sentence and sentence.count("LeftArm") == 1 and "Head" in sentence


def test_fast_but_real_motion_is_kept(clip):
    # A throw: 2.4 rad in a tenth of a second and back, 38 rad/s at most.
    t = np.arange(clip.frames) / clip.fps
    rise = np.clip((t - 0.3) / 0.1, 0.0, 1.0) - np.clip((t - 0.6) / 0.1, 0.0, 1.0)
    throw = twisted(clip, 2.4 * (1 - np.cos(math.pi * rise)) / 2)
    peak = apart(throw.replaced(rot=np.roll(throw.rot, 1, 0)), throw)[1:].max() * clip.fps
    assert 30.0 < peak < IMPOSSIBLE_SPEED
    same, spikes = remove_spikes(throw)
    assert same is throw and spikes == ()


@pytest.mark.parametrize("stop", [75, 121])
def test_a_flip_that_stays_is_kept(clip, stop):
    # For good, or for an eighth of a second: its two ends are too far apart to be one brief turn.
    frames = np.arange(clip.frames)
    angles = np.where((frames >= 60) & (frames < stop), 2.8, 0.0)
    flipped = twisted(clip, angles)
    same, spikes = remove_spikes(flipped)
    assert same is flipped and spikes == ()


@pytest.mark.parametrize("where", [slice(0, 2), slice(-2, None)])
def test_damage_at_an_end_has_nothing_to_be_joined_to(clip, where):
    angles = np.zeros(clip.frames)
    angles[where] = 2.8
    broken = twisted(clip, angles)
    same, spikes = remove_spikes(broken)
    assert same is broken and spikes == ()


def test_long_damage_is_left(clip):
    # It trembles for half a second: nobody knows what the arm did.
    angles = np.zeros(clip.frames)
    angles[30:90:2] = 1.5
    broken = twisted(clip, angles)
    same, spikes = remove_spikes(broken)
    assert same is broken and spikes == ()


def test_the_argument_does_not_change(clip):
    angles = np.zeros(clip.frames)
    angles[50] = 2.8
    broken = twisted(clip, angles)
    before = broken.rot.copy()
    mended, spikes = remove_spikes(broken)
    assert spikes and np.array_equal(broken.rot, before) and mended is not broken
    again, none = remove_spikes(mended)
    assert again is mended and none == ()
