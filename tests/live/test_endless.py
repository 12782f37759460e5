"""Endless motion of live characters: segments that are tried before, from where the character is."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import count

import numpy as np
import pytest
import torch
from torch import Tensor

from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.live.beside import Beside, SnapshotArrays
from poise.live.characters import TRACKS
from poise.live.endless import (
    AHEAD,
    CharacterHere,
    CharacterNow,
    EndlessCoords,
    SegmentAsked,
    SegmentMade,
    SegmentMaker,
)
from poise.live.people import Offset
from poise.live.session import Live, LiveConfig, generator_for
from poise.plan.rehearsal import TriedFuture

STEP = 1 / 30


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


# --- what is asked for -----------------------------------------------------------------------------


class Asked:
    """Gives segments along x when it is told to, 60 frames of 0.1 m, with what is expected."""

    def __init__(self) -> None:
        self.all: list[tuple[SegmentAsked, Future[SegmentMade]]] = []

    def __call__(self, asked: SegmentAsked) -> Future[SegmentMade]:
        made: Future[SegmentMade] = Future()
        self.all.append((asked, made))
        return made

    def answer(self) -> None:
        asked, made = self.all[-1]
        frames = np.repeat(asked.past[-1:], 60, 0)
        frames[:, 0] += 0.1 * np.arange(1, 61)
        made.set_result(
            SegmentMade(frames, asked.rng, asked.where(frames[:-1]), SnapshotArrays({}, 0, {}))
        )


EASE = np.array([1.0, 2.0, 0.9, 1.0, 0.0, 0.0, 0.0, 0.3])


def standing(qpos: np.ndarray, lead: int = 3) -> CharacterHere:
    return CharacterHere(qpos, lead, lambda: CharacterNow(SnapshotArrays({}, 0, {}), EASE[None]))


def test_it_stands_until_more_is_made_and_asks_in_time() -> None:
    ask = Asked()
    coords = EndlessCoords(ask, EASE, 5, 60, 30.0)
    assert [coords.next().tolist() for _ in range(3)] == [EASE.tolist()] * 3
    # A character that stands is in no hurry.
    assert len(ask.all) == 1 and ask.all[0][0].spare_s == np.inf
    assert ask.all[0][0].past.tolist() == [EASE.tolist()] * 5
    ask.answer()
    seen = [coords.next()[0] for _ in range(60)]
    assert np.allclose(seen, 1.0 + 0.1 * np.arange(1, 61))
    asked = ask.all[1][0]
    assert len(ask.all) == 2 and asked.spare_s == pytest.approx((AHEAD - 1) / 30)
    assert np.allclose(asked.past[:, 0], 1.0 + 0.1 * np.arange(56, 61))


def test_it_stands_where_the_character_lost_it_and_begins_from_there() -> None:
    ask = Asked()
    coords = EndlessCoords(ask, EASE, 5, 60, 30.0)
    coords.next()
    ask.answer()
    last = [coords.next() for _ in range(10)][-1]
    coords.move(last, np.array([9.0, 9.0, 0.9, *EASE[3:]]))
    seen = [coords.next(waits=True) for _ in range(4)]
    assert all(np.allclose(q, [9.0, 9.0, *EASE[2:]]) for q in seen) and len(ask.all) == 1
    coords.next()
    # Frames that were made before do not count any more.
    assert ask.all[1][0].spare_s == np.inf and np.allclose(ask.all[1][0].past[:, 0], last[0])


@pytest.mark.parametrize("off", [0.0, 0.05])
def test_a_character_is_copied_where_it_does_not_do_as_expected(off: float) -> None:
    ask = Asked()
    coords = EndlessCoords(ask, EASE, 5, 60, 30.0)
    body = coords.next()
    ask.answer()
    given = [body]
    while len(ask.all) == 1:
        # The goal is three frames behind the newest.
        here = standing(given[-3] + off if len(given) > 3 else given[0])
        given.append(coords.next(here=here))
    asked = ask.all[1][0]
    assert (asked.end is None, asked.now is None) == ((True, False) if off else (False, True))
    if asked.now is not None:
        # With the frames that are known already, those that wait included.
        assert len(asked.now.frames) == 1 + AHEAD - 1


# --- what is made ----------------------------------------------------------------------------------


class Line:
    """Goes on along x, each future at a speed of its own; stands for a generator and for what tries."""

    past, future, sees = 3, 8, 1

    def propose(
        self, past: Tensor, rng: torch.Generator, count: int, ids: Tensor, usual: int | None = None
    ) -> Tensor:
        made = past[:, None, -1:].repeat(1, count, self.future, 1)
        speeds = torch.arange(1, count + 1)[:, None] * torch.arange(1, self.future + 1)
        made[..., 0] += speeds
        return made

    def __len__(self) -> int:
        return 4

    def stand(self, past: Tensor) -> None:
        self.stood = past.clone()

    def find(
        self, futures: Callable[[int], Tensor], begin: Callable[[], None], by_s: float | None
    ) -> TriedFuture:
        assert len(futures(0)) == len(self) and len(futures(1)) == len(self)
        begin()
        return TriedFuture(1, 2, 5, False)


def asked_of(line: Line, by_s: float | None = None) -> SegmentAsked:
    rng = torch.Generator().manual_seed(0).get_state().numpy()
    where = Offset(shift=np.array([0.0, 7.0, 0.0]))
    return SegmentAsked(np.zeros((line.past, 8)), rng, [], None, None, where, 1.0, by_s)


def test_the_future_that_was_done_is_taken() -> None:
    line = Line()
    made = SegmentMaker(line, line)(asked_of(line))  # type: ignore[arg-type]
    # Five frames of the third future; it is tried where the character is.
    assert made.frames[:, 0].tolist() == [3.0 * k for k in range(1, 6)]
    assert line.stood[:, 1].tolist() == [7.0] * 3 and made.path is None and made.end is None


def test_what_would_come_too_late_is_not_tried() -> None:
    line = Line()
    made = SegmentMaker(line, line)(asked_of(line, by_s=0.0))  # type: ignore[arg-type]
    assert made.frames[:, 0].tolist() == [1.0, 2.0, 3.0, 4.0] and not hasattr(line, "stood")


# --- the whole -------------------------------------------------------------------------------------


def test_a_copy_does_what_the_character_does_then(tracker: Tracker) -> None:
    live = Live(tracker, clock=lambda: 0.0, generator=generator_for(tracker))
    live.aims.dream(0, True)
    coords, seen = live.aims.endless[0], list[tuple[bool, bool]]()
    ask, off = coords.ask, list[float]()

    def heard(asked: SegmentAsked) -> Future[SegmentMade]:
        seen.append((asked.now is not None, asked.end is not None))
        return ask(asked)

    coords.ask = heard
    for k in range(240):
        step = live.step(k * STEP)
        lead, given = live.world.lead[0], coords.given
        # Of the frame that it was at in this step, as was expected when its frames were made.
        if step is not None and len(given) > lead and (path := given[-lead]) is not None:
            off.append(float(np.abs(step.qpos[0] - path).max()))
    assert live.world.characters[0].doing == TRACKS and live.world.characters[0].lost == 0
    # First a copy of what it is; once the policy sees as far as the copy, of what it was expected to be.
    assert seen[0] == (True, False) and seen[-1] == (False, True)
    assert len(off) > 120 and np.median(off[-50:]) < 1e-3
    live.close()


def test_goals_of_endless_motion_are_as_far_ahead_as_the_policy_sees(tracker: Tracker) -> None:
    live = Live(tracker, clock=lambda: 0.0, generator=generator_for(tracker))
    short, far = live.aims.lead, max(tracker.config.window)
    assert live.world.lead == [short] and short < far
    live.aims.dream(0, True)
    for k in range(90):
        live.step(k * STEP)
    assert live.world.lead == [far]
    live.aims.dream(0, False)
    # It is behind by ever less, without a leap.
    seen = list[int]()
    for k in range(30):
        live.step(3.0 + k * STEP)
        seen.append(live.world.lead[0])
    assert (seen[-1] == short and max(-np.diff([far, *seen])) <= 1) or live.world.characters[0].anew
    live.close()


def test_several_that_dream_do_not_look_ahead(tracker: Tracker) -> None:
    live = Live(tracker, LiveConfig(3, lookahead=3), clock=lambda: 0.0, generator=generator_for(tracker))
    live.aims.dream(0, True)
    assert live.world.ahead_of == (0, 1, 2)
    live.aims.dream(2, True)
    assert live.world.ahead_of == (1,) and live.figures()["lookahead"] == 3
    live.aims.dream(0, False)
    assert live.world.ahead_of == (0, 1, 2)
    live.close()


def double(tensor: Tensor) -> Callable[[int], float]:
    """Answers in the other process."""
    return lambda asked: float(tensor[asked] * 2)


def test_a_process_beside_the_loop_answers_and_takes_nothing_away() -> None:
    numbers = torch.arange(100_000.0)
    looks = numbers.numpy()
    beside = Beside[int, float](double, (numbers,), 1)
    assert [beside.ask(k).result(120) for k in (3, 70_000)] == [6.0, 140_000.0]
    # Arrays that look at what was handed over still do.
    assert numbers.data_ptr() == looks.ctypes.data and float(looks[70_000]) == 70_000.0
    beside.close()


def test_another_process_goes_on_where_one_has_ended(tracker: Tracker) -> None:
    before = multiprocessing.active_children()
    with ThreadPoolExecutor(1) as pool:
        live = Live(tracker, executor=pool, clock=lambda: 0.0, generator=generator_for(tracker))
        live.aims.dream(0, True)
        coords, steps = live.aims.endless[0], count()

        def moves() -> bool:
            """Whether motion comes, waited for as long as the busiest machine needs."""
            coming, until = len(coords.coming()), time.monotonic() + 120
            while len(coords.coming()) <= max(1, coming) and time.monotonic() < until:
                live.step(next(steps) * STEP)
                time.sleep(0.005)
            return len(coords.coming()) > max(1, coming)

        assert moves()
        (process,) = (p for p in multiprocessing.active_children() if p not in before)
        assert process.pid is not None
        os.kill(process.pid, signal.SIGTERM)
        process.join(30)
        for _ in range(40):
            live.step(next(steps) * STEP)
        assert moves() and live.world.characters[0].doing == TRACKS
        live.close()
    assert multiprocessing.active_children() == before
