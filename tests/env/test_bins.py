"""MotionBins of clips: how they are cut, what episodes say of them, where training then begins."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from poise.control import SuccessHelp
from poise.env import ImitationEnv
from poise.env.bins import MotionBins, Outcomes
from poise.env.events import EVERY, KEPT, PRIOR, AdaptiveSampling
from poise.env.starts import Starts
from poise.recipes.imitation import Imitation
from refusals import refused
from toy_human import swing

RATE = 30.0
RULE = SuccessHelp(factor=0.5, smallest=0.2, every=2)


def cut(*length: int, cyclic: tuple[int, ...] = (), seconds: float = 1.0) -> MotionBins:
    loops = torch.tensor([k in cyclic for k in range(len(length))])
    return MotionBins.cut(torch.tensor(length), loops, RATE, seconds)


def test_clips_are_cut_into_moments_of_nearly_equal_length():
    m = cut(100, 3, 46, 31, cyclic=(3,))
    assert len(m) == 3 + 1 + 2 + 1
    assert m.clip.tolist() == [0, 0, 0, 1, 2, 2, 3] and m.offset.tolist() == [0, 3, 4, 6]
    assert m.size.tolist() == [34, 33, 33, 3, 23, 23, 30]
    assert m.before.tolist() == [2, 0, 1, 3, 5, 4, 6]
    # Every row is in the moment that covers it.
    row = 0
    for clip, length in enumerate((100, 3, 46, 31)):
        for frame in range(length):
            k = int(m.of[row])
            if (clip, frame) != (3, 30):  # The last frame of a cycle is its first, and never visited.
                assert m.clip[k] == clip and 0 <= frame - m.begin[k] < m.size[k]
                assert m.into[row] == frame - m.begin[k]
                assert bool(m.last[row]) == (frame == m.begin[k] + m.size[k] - 1)
            row += 1


def test_outcomes_by_hand():
    m = cut(90)
    # Fails early in its own moment; fails after having come through the one before; leaves the second
    # moment having seen all, a third and two thirds of the first; somewhere; the clip's end.
    row = torch.tensor([40, 40, 59, 59, 59, 50, 89])
    age = torch.tensor([5, 30, 59, 39, 49, 30, 70])
    failed = torch.tensor([1, 1, 0, 0, 0, 0, 0]).bool()
    done = torch.tensor([0, 0, 0, 0, 0, 0, 1]).bool()
    seen = m.outcomes(row, age, failed, done)
    assert seen.bin.tolist() == [1, 1, 1, 1, 1, 1, 2, 0, 0, 0, 0, 0, 0, 1]
    assert seen.ended.tolist() == [1, 1, 0, 0, 0, 0, 1, 0, 1, 1, 0, 1, 0, 1]
    assert seen.failed.tolist() == [1, 1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0]
    some = seen.of(torch.tensor([0, 1, 1, 1, 1, 1, 1]).bool())
    assert some.ended.tolist() == [0, 1, 0, 0, 0, 0, 1, 0, 1, 1, 0, 1, 0, 1]
    assert float(some.failed.sum()) == 2.0


def walk(
    m: MotionBins, length: int, cyclic: bool, start: int, falls: int | None
) -> list[tuple[int, int]]:
    """(moment, failed) of one episode of a single clip, written out frame by frame."""
    out, path = [], []
    frames = length - cyclic
    for frame in range(start, (falls or 10**9) + 1):
        k = int(m.of[frame % frames if cyclic else frame])
        if not path or path[-1][0] != k or (cyclic and frame % frames == 0 and frame > start):
            path.append([k, 0])
        path[-1][1] += 1
        if frame == start:
            continue
        there = path[:-1]
        if frame == falls:
            out.append((k, 1))
            if there:
                out.append((there[-1][0], 1))
            break
        leaves = bool(m.last[frame % frames if cyclic else frame])
        if leaves and there and 2 * there[-1][1] >= int(m.size[there[-1][0]]):
            out.append((there[-1][0], 0))
        if not cyclic and frame == length - 1:
            out.append((k, 0))
            break
        if len(out) > 12:
            break
    return out


@pytest.mark.parametrize("cyclic", [False, True])
def test_outcomes_of_whole_episodes(cyclic: bool):
    length = 170
    m = cut(length, cyclic=(0,) if cyclic else ())
    frames = length - cyclic
    for start in (0, 3, 15, 20, 29, 100, 168):
        for falls in (None, 16, 45, 69, 100, 169):
            if falls is not None and falls <= start:
                continue
            wanted = walk(m, length, cyclic, start, falls)
            found = []
            for frame in range(start + 1, 10**4):
                row = torch.tensor([frame % frames if cyclic else frame])
                over = torch.tensor([frame == falls])
                done = torch.tensor([not cyclic and frame == length - 1 and falls != frame])
                seen = m.outcomes(row, torch.tensor([frame - start]), over, done)
                order = zip(seen.bin, seen.ended, seen.failed, strict=True)
                step = [(int(k), int(f)) for k, e, f in order if e]
                found += step if over or done else step[::-1]
                if over or done or len(found) > 12:
                    break
            assert sorted(found[:12]) == sorted(wanted[:12]), (start, falls)


def test_means_and_maxima_of_clips():
    m = cut(90, 30)
    values = torch.tensor([0.0, 0.5, 1.0, 0.25])
    assert m.by_clip(values).tolist() == [0.5, 0.25]
    assert m.by_clip(values, most=True).tolist() == [1.0, 0.25]


def outcome(bin: int, failed: bool) -> Outcomes:
    return Outcomes(torch.tensor([bin]), torch.ones(1).double(), torch.tensor([failed]).double())


def test_moments_are_hard_where_episodes_fail():
    hard = AdaptiveSampling(3)
    assert hard.odds.tolist() == [0.0] * 3
    for k in range(EVERY):
        hard.add(outcome(k % 2, failed=k % 4 == 0))
    # Of 32 episodes of the first, half failed.
    share = 16 / (32 + PRIOR)
    assert hard.odds.tolist() == pytest.approx([share * (1.1 - share), 0.0, 0.0])
    other = AdaptiveSampling(3)
    other.load_state(hard.state())
    for each in (hard, other):
        for _ in range(EVERY):
            each.add(outcome(2, failed=True))
        share = 16 * KEPT / (32 * KEPT + PRIOR)
        assert each.odds[0] == pytest.approx(share * (1.1 - share))
        # Always failing counts less than failing half of the time, but not for nothing.
        always = EVERY / (EVERY + PRIOR)
        assert each.odds[2] == pytest.approx(always * (1.1 - always))
        assert 0.1 < each.odds[2] < each.odds[0]
    # Of other moments nothing is known.
    fresh = AdaptiveSampling(4)
    fresh.load_state(hard.state())
    assert fresh.odds.tolist() == [0.0] * 4


def drawn(
    odds: Tensor | None, hard: float = 1.0, first: float = 0.0, over: str = "clip", weight: float = 1.0
) -> tuple[Tensor, Tensor]:
    length = torch.tensor([300, 150])
    bins = MotionBins.cut(length, torch.zeros(2).bool(), RATE)
    starts = Starts(length, torch.tensor([1.0, weight]), 7, first, bins, hard, over)
    return starts.draw(20_000, odds)


def test_episodes_begin_before_hard_moments_of_their_clip():
    odds = torch.zeros(15).double()
    odds[[4, 8]] = torch.tensor([0.1, 0.3]).double()
    clip, frame = drawn(odds)
    assert float((clip == 0).double().mean()) == pytest.approx(0.5, abs=0.02)
    ours = frame[clip == 0]
    # The middles are frames 135 and 255; two seconds before each.
    early, late = (ours >= 75) & (ours <= 135), (ours >= 195) & (ours <= 255)
    assert bool((early | late).all())
    assert float(late.double().mean()) == pytest.approx(0.75, abs=0.02)
    # Nothing of the other clip is hard: it begins anywhere.
    other = frame[clip == 1]
    assert float(other.double().mean()) == pytest.approx(74, abs=2) and int(other.max()) == 148
    clip, frame = drawn(odds, 0.5, 0.1)
    ours = frame[clip == 0]
    near = ((ours >= 75) & (ours <= 135) | (ours >= 195) & (ours <= 255)).double().mean()
    assert float(near) == pytest.approx(0.9 * (0.5 + 0.5 * 122 / 299), abs=0.02)
    assert float((ours == 0).double().mean()) == pytest.approx(0.1, abs=0.02)


def test_hard_moments_of_a_whole_library_decide_which_clips_are_drawn():
    odds = torch.zeros(15).double()
    odds[[4, 12]] = torch.tensor([0.1, 0.3]).double()
    clip, frame = drawn(odds, over="library")
    assert float((clip == 1).double().mean()) == pytest.approx(0.75, abs=0.02)
    assert int(frame[clip == 0].min()) >= 75 and int(frame[clip == 0].max()) <= 135
    assert int(frame[clip == 1].min()) >= 15 and int(frame[clip == 1].max()) <= 75
    # Half of the starts as without.
    clip, _ = drawn(odds, 0.5, over="library")
    assert float((clip == 1).double().mean()) == pytest.approx(0.5 * 0.75 + 0.25, abs=0.02)
    # What is not drawn at all is not practised, and nothing hard is as without.
    assert not bool(drawn(odds, over="library", weight=0.0)[0].any())
    torch.testing.assert_close(drawn(0 * odds, over="library"), drawn(0 * odds))


def test_starts_stay_within_clips():
    odds = torch.zeros(15).double()
    odds[[0, 9, 14]] = 1e-9
    clip, frame = drawn(odds)
    ours, other = frame[clip == 0], frame[clip == 1]
    assert int(ours.min()) == 0 and int(ours.max()) <= 285
    assert int(other.min()) >= 75 and int(other.max()) <= 135
    # Without odds, or a share, nothing is drawn otherwise than before there were any.
    for same in (drawn(None), drawn(odds, 0.0)):
        torch.testing.assert_close(same, drawn(None, 0.0))
    with refused("out-of-range"):
        drawn(odds, 1.5)


@pytest.fixture(scope="module")
def task(make_task: Callable[..., Imitation]) -> Imitation:
    clips = swing(3.0), swing(2.0, bend=0.4, name="second")
    built = make_task(*clips, help_start=100.0, help_limit=0.0)
    own = replace(built.task, help=RULE, help_by="bin", adaptive=0.5)
    return replace(built, task=own)


def pushed(env: ImitationEnv, frames: list[int]) -> Tensor:
    """The forces on the root of worlds that act alike at frames of the first clip."""
    env.reset_to(torch.zeros(len(frames), dtype=torch.long), torch.tensor(frames))
    env.step(torch.ones(len(frames), env.num_actions))
    assert env.wrench is not None
    return env.wrench.force.norm(dim=-1).flatten(1).amax(1)


def test_each_moment_has_its_own_help(task: Imitation):
    env = task.env(4, threads=1)
    env.help.schedule = None
    assert env.help.groups == len(task.reference.bins) == 5
    full = pushed(env, [5, 29, 30, 70])
    env.help.set(torch.tensor([1.0, 0.5, 0.0, 1.0, 1.0]))
    # Frame 31 is reached from frame 30, and that step is the second moment's.
    ratio = pushed(env, [5, 29, 30, 70]) / full
    torch.testing.assert_close(ratio, torch.tensor([1.0, 1.0, 0.5, 0.0]).to(ratio), rtol=0.02, atol=0.0)
    # MotionBins of clips that are not drawn do not count.
    env.help.set(torch.tensor([0.0, 0.0, 0.0, 1.0, 1.0]))
    assert env.help.now == 1.0
    env.weights = torch.tensor([1.0, 0.0])
    assert env.help.now == 0.0
    env.close()


def test_a_run_goes_on_where_it_was(task: Imitation):
    one, two = task.env(6, threads=1), task.env(6, threads=1)
    rng = torch.Generator().manual_seed(0)
    one.reset()
    for _ in range(EVERY + 20):
        one.step(torch.randn(6, one.num_actions, generator=rng))
    rates = one.event(AdaptiveSampling)
    assert rates is not None and float(rates.odds.max()) > 0.1
    two.load_state(one.state())
    for _ in range(EVERY):
        action = torch.randn(6, one.num_actions, generator=rng)
        a, b = one.step(action), two.step(action)
        assert torch.equal(a.obs, b.obs) and torch.equal(a.reward, b.reward)
    assert all(torch.equal(x, two.state()[name]) for name, x in one.state().items() if name != "sim")
    one.close()
    two.close()
