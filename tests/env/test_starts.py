"""Where episodes begin: odds of clips, frames, seeds, and odds that are part of the state."""

from __future__ import annotations

import pytest
import torch

from poise.env.starts import Starts
from poise.learn import HardNegatives
from refusals import refused
from toy_human import swing

LENGTH = torch.tensor([5, 11, 3])


def test_starts_follow_the_odds_and_leave_a_step_to_make():
    starts = Starts(LENGTH)
    clip, frame = starts.draw(6000)
    share = torch.bincount(clip, minlength=3) / 6000
    torch.testing.assert_close(
        share.double(), torch.tensor([4, 10, 2.0]).double() / 16, atol=0.02, rtol=0
    )
    for c, n in enumerate(LENGTH.tolist()):
        counts = torch.bincount(frame[clip == c])
        assert len(counts) == n - 1 and float(counts.min()) > 0.7 * float(counts.float().mean())
    starts.weights = torch.tensor([1, 0, 3])
    clip, _ = starts.draw(4000)
    assert not (clip == 1).any() and float((clip == 2).float().mean()) == pytest.approx(0.75, abs=0.03)


def test_a_share_of_the_starts_stands_on_frame_0():
    even = Starts(LENGTH, torch.tensor([0.0, 1.0, 0.0]), first=0.5).draw(4000)[1]
    assert float((even == 0).float().mean()) == pytest.approx(0.5 + 0.5 / 10, abs=0.03)
    assert not Starts(LENGTH, first=1.0).draw(50)[1].any()
    # Without such a share nothing else is drawn.
    a, b = Starts(LENGTH, seed=3), Starts(LENGTH, seed=3, first=0.0)
    assert all(torch.equal(x, y) for x, y in zip(a.draw(9), b.draw(9), strict=True))


def test_odds_that_cannot_be_are_refused():
    starts = Starts(LENGTH)
    for odds in ([1.0, 1.0], [0.0, 0.0, 0.0], [1.0, -1.0, 1.0], [1.0, float("nan"), 1.0]):
        with refused("bad-weights"):
            starts.weights = torch.tensor(odds)
    assert starts.weights.tolist() == [4.0, 10.0, 2.0]
    starts.weights[0] = 99.0  # A copy.
    assert starts.weights.tolist() == [4.0, 10.0, 2.0]
    with refused("out-of-range", says="frame 0"):
        Starts(LENGTH, first=1.5)


def test_an_environment_draws_hard_clips_and_remembers_it(make_env):
    clips = (swing(0.4), swing(0.5, name="b"), swing(0.6, name="c"))
    env, other = make_env(64, clips=clips), make_env(64, seed=7, clips=clips)
    hard = HardNegatives(3)
    hard.record(torch.tensor([True, False, True]))
    env.weights = hard.weights()
    env.reset()
    # floor: 0.3 / 3 + 0.7 of all draws
    assert float((env.clip == 1).float().mean()) == pytest.approx(0.8, abs=0.15)
    assert torch.equal(env.weights, hard.weights())
    state = env.state()
    other.load_state(state)
    assert torch.equal(other.weights, hard.weights())
    assert torch.equal(env.reset(), other.reset()) and torch.equal(env.clip, other.clip)
    # What former versions saved is without odds.
    del state["weights"]
    other.load_state(state)
    assert torch.equal(other.weights, hard.weights())
    env.close()
    other.close()
