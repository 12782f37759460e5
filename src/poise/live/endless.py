"""Motion without end for live characters: segments are asked for before they are needed, and a maker
tries several futures of each with copies of the character before it takes one."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.env.generator_goal import IN_THE_WAY, SOME, cost_of
from poise.live.beside import SnapshotArrays
from poise.live.people import Offset
from poise.plan.rehearsal import FutureTrials
from poise.synthesis.generator import Kinematic

#: Frames that wait at least; below it more are made.
AHEAD = 45
#: m of the root, and rad of the hinges on average, by which a character may be elsewhere than expected;
#: frames of which it is kept what was expected.
OFF_M, OFF, GIVEN = 0.002, 0.002, 32


class CharacterNow(NamedTuple):
    """A character that is on its motion.

    Attributes:
        world: its snapshot.
        frames: `(k, 7 + n)`, the one before the one that it is at, that one, and those to come.
    """

    world: SnapshotArrays
    frames: np.ndarray


class CharacterHere(NamedTuple):
    """A character on its motion, of which only what is asked for is made.

    Attributes:
        qpos: `(7 + n)`. lead: frames by which it is behind the newest that its goal knows.
        now: gives it with those frames.
    """

    qpos: np.ndarray
    lead: int
    now: Callable[[], CharacterNow]


class SegmentAsked(NamedTuple):
    """A question for more motion.

    Attributes:
        past: `(p, 7 + n)` frames that it follows.
        rng: state of the generator of its draws.
        others: `(f, 2)` m each, where others are in the frames that are to be made.
        now: the character; None where it is not on the motion, or is as it was expected to be.
        end: what a copy of it was shortly before the end of `past`, where it is as expected.
        where: where its world is against that of the motion.
        spare_s: s for which frames wait; without end where it stands.
        by_s: the end of these by `time.time`, by which it is needed; None where nothing hurries.
    """

    past: np.ndarray
    rng: np.ndarray
    others: list[np.ndarray]
    now: CharacterNow | None
    end: SnapshotArrays | None
    where: Offset
    spare_s: float
    by_s: float | None = None


class SegmentMade(NamedTuple):
    """More motion.

    Attributes:
        frames: `(f, 7 + n)`. rng: state of the generator of its draws after it.
        path: `(g, 7 + n)`, what the character is expected to do in the first g of them, in its world.
        end: what it is then. Both None where nothing is known.
    """

    frames: np.ndarray
    rng: np.ndarray
    path: np.ndarray | None = None
    end: SnapshotArrays | None = None


class SegmentMaker:
    """Makes segments of motion, each tried before, see `plan.rehearsal`.

    Args:
        generator: makes futures.
        trials: copies of a character in which they are tried.
    """

    def __init__(self, generator: Kinematic, trials: FutureTrials):
        self.generator, self.trials = generator, trials
        # s that the last segment took.
        self._took = 0.0

    def __call__(self, asked: SegmentAsked) -> SegmentMade:
        """One segment. If it would come too late after a trial, it is the first half of the first
        future, untried."""
        begun, trials, past = time.time(), self.trials, torch.from_numpy(asked.past)
        rng = torch.Generator()
        rng.set_state(torch.from_numpy(asked.rng))
        others = [torch.from_numpy(o) for o in asked.others]
        near = any(float((o - past[-1, :2]).norm(dim=-1).amin()) < IN_THE_WAY for o in others)
        # The others may turn meanwhile: half of it is done before more is made.
        half = -(-self.generator.future // 2)
        keeps, drawn = half if near else self.generator.future, list[Tensor]()

        def draw() -> Tensor:
            many = SOME if near else len(trials)
            made = self._futures(past, rng, many, near, others)[: len(trials), :keeps]
            drawn.append(made)
            return made

        if asked.by_s is not None and begun + self._took > asked.by_s:
            # One slow trial is not to keep all later futures from being tried.
            self._took *= 0.9
            return SegmentMade(draw()[0, :half].numpy().copy(), rng.get_state().numpy())
        there, ahead = torch.from_numpy(asked.where(asked.past)), None
        if asked.end is not None:
            ahead = trials.follow(asked.end.snapshot(), there, len(there) - 1 - trials.sees)
        elif asked.now is not None:
            ahead = trials.follow(asked.now.world.snapshot(), torch.from_numpy(asked.now.frames), 1)
        begin = partial(trials.stand, there) if ahead is None else partial(trials.restore, ahead)
        found = trials.find(lambda _: torch.from_numpy(asked.where(draw().numpy())), begin, asked.by_s)
        self._took = time.time() - begun
        frames = drawn[found.drawn][found.which, : found.frames]
        path = None if found.path is None else found.path.double().numpy()
        end = None if found.end is None else SnapshotArrays.of(found.end)
        return SegmentMade(frames.numpy().copy(), rng.get_state().numpy(), path, end)

    def _futures(
        self, past: Tensor, rng: torch.Generator, count: int, near: bool, others: Sequence[Tensor]
    ) -> Tensor:
        """`(count, f, 7 + n)`, those that keep away from the others first, where they are near."""
        one = torch.zeros(1, dtype=torch.long)
        made = self.generator.propose(past[None], rng, count, one, None if near else count)[0]
        return made[cost_of(made[..., :2], None, others).argsort(stable=True)] if near else made


class EndlessCoords:
    """Coordinates of a body at the control rate, without end. The character stands at first, and again
    once it has got up, since what it fell in is in the middle of something.

    Args:
        ask: for more motion, which comes when it is made.
        ease: `(7 + n)`, how the character stands.
        past, future: frames that the generator sees and makes. fps: of its frames.
        seed: of its draws.

    Attributes:
        given: what the character is expected to do in the last frames that were given, `(7 + n)` each,
            None where that is not known.
    """

    def __init__(
        self,
        ask: Callable[[SegmentAsked], Future[SegmentMade]],
        ease: np.ndarray,
        past: int,
        future: int,
        fps: float,
        seed: int = 0,
    ):
        self.ask, self._ease, self._future, self._fps = ask, ease, future, fps
        self._rng = torch.Generator().manual_seed(seed).get_state().numpy()
        self._past = np.repeat(ease[None], past, 0)
        # Frames that wait, and what the character is expected to do in them.
        self._frames, self._paths = deque[np.ndarray](), deque[np.ndarray | None]()
        self.given = deque[np.ndarray | None](maxlen=GIVEN)
        # The character as it is to be shortly before the last frame that waits.
        self._end: SnapshotArrays | None = None
        self._made: Future[SegmentMade] | None = None
        self._last, self._where, self._waits = ease, Offset(), False
        # Whether nothing was made since it stands.
        self._stands = True

    def next(
        self,
        waits: bool = False,
        others: Sequence[np.ndarray] = (),
        here: CharacterHere | None = None,
    ) -> np.ndarray:
        """The next frame `(7 + n)`; the last one again until more is made.

        Args:
            waits: the character is yet to come to where it is, and it waits for it.
            others: `(m, 3)` m each, where the roots of other characters are in the next frames, as far
                as that is known; it keeps away from them.
            here: the character, None where it is not on the motion.
        """
        if waits and not self._waits:
            self._stand()
        self._waits = waits
        if not waits:
            self._more(others, here)
        if self._frames and not waits:
            self._last = self._frames.popleft()
            self.given.append(self._paths.popleft())
        return self._where(self._last)

    def move(self, seen: np.ndarray, to: np.ndarray) -> None:
        """Lets it go on so that the coordinates `seen (7 + n)` are where and face as `to` does."""
        self._where.move(seen, to)

    def coming(self) -> np.ndarray:
        """`(m, 3)` m, where its root is in the next frames, as far as they are made."""
        return self._where.points(np.array([f[:3] for f in (self._last, *self._frames)]))

    def _stand(self) -> None:
        """It stands where it is, and nothing of what follows is made yet."""
        there = Offset()
        there.move(self._ease, self._last)
        self._last = there(self._ease)
        self._past = np.repeat(self._last[None], len(self._past), 0)
        for known in (self._frames, self._paths, self.given):
            known.clear()
        self._made, self._end, self._stands = None, None, True

    def _more(self, others: Sequence[np.ndarray], here: CharacterHere | None) -> None:
        if self._made is not None and self._made.cancelled():
            self._made = None
        elif self._made is not None and self._made.done():
            (made, self._rng, path, self._end), self._made = self._made.result(), None
            self._past = np.concatenate((self._past, made))[-len(self._past) :]
            self._frames.extend(made)
            path = [] if path is None else list(path)
            self._paths.extend([*path, *[None] * (len(made) - len(path))])
            self._stands = False
        if self._made is None and len(self._frames) < AHEAD:
            there = [self._there(places) for places in others if len(places)]
            now, end = None, None
            if here is not None and self._expected(here):
                end = self._end
            elif here is not None:
                now = here.now()
                coming = [self._where(f) for f in self._frames]
                now = now._replace(frames=np.stack([*now.frames, *coming]))
            spare = math.inf if self._stands else len(self._frames) / self._fps
            asked = (self._past, self._rng, there, now, end, replace(self._where), spare)
            self._made = self.ask(SegmentAsked(*asked))

    def _expected(self, here: CharacterHere) -> bool:
        """Whether a character does as it was expected to, and it is known what it is later."""
        path = self.given[-here.lead] if len(self.given) >= here.lead else None
        if self._end is None or path is None:
            return False
        off = np.abs(here.qpos - path)
        return bool(off[:3].max() < OFF_M and off[7:].mean() < OFF)

    def _there(self, places: np.ndarray) -> np.ndarray:
        """`(f, 2)` m, where another one is in the frames that are to be made, in the motion's world;
        beyond what is known it goes on as it goes."""
        index = len(self._frames) + np.arange(1, self._future + 1)
        last = len(places) - 1
        before = max(0, last - AHEAD // 3)
        step = (places[last] - places[before]) / max(1, last - before)
        found = places[np.minimum(index, last)] + np.maximum(index - last, 0)[:, None] * step
        return self._where.back(found)[:, :2].copy()
