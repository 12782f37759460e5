"""The next goal of each character: its person's pose, endless motion, or what its state asks for."""

from __future__ import annotations

import time
from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from poise.jobs.endless.dreaming import trials_of
from poise.jobs.tracker import Tracker
from poise.live.beside import Beside, SnapshotArrays
from poise.live.characters import FALLS, RETURNS, tensor
from poise.live.endless import (
    CharacterHere,
    CharacterNow,
    EndlessCoords,
    SegmentAsked,
    SegmentMade,
    SegmentMaker,
)
from poise.live.people import Own, People, calibrated
from poise.live.protocol import LiveConfig
from poise.live.stream import margin
from poise.live.world import LiveWorld
from poise.synthesis.generator import Kinematic

#: Share by which motion is faster or slower while what is behind is caught up with, and s behind which
#: nothing is caught up with.
CATCHES_UP, GIVES_UP_S = 0.15, 1.5
#: s in which errors wander.
WANDERS_S = 0.3
#: Futures of endless motion that are tried at once; by how much the process that tries them comes after
#: the loop, as `nice` counts.
TRIES, NICE = 8, 2


class Targets:
    """The people that come, and what characters make of them.

    Args:
        executor: calibrates and makes endless motion beside the loop; None does it at once.
        generator: makes endless motion; None: there is none.

    Attributes:
        noise: 0 to 1, see `LiveConfig`.
        endless: characters that follow endless motion.
        read_s: when people were read last.
    """

    def __init__(
        self,
        world: LiveWorld,
        config: LiveConfig,
        executor: Executor | None,
        generator: Kinematic | None,
    ):
        self.world, self.noise, self.generator = world, config.noise, generator
        self._executor = executor
        # Made where it is asked for first.
        self._maker: SegmentMaker | Beside[SegmentAsked, SegmentMade] | None = None
        t = world.tracker
        ease = t.recovery_clips.ease.numpy() if t.recovery_clips is not None else np.zeros(0)
        body = {"humanoid": t.humanoid, "example": t.example, "ease": ease, "how": t.onto}
        calibrate = partial(calibrated, **body)
        self.people = People(config.characters, config.buffer_s, calibrate, executor)
        self.endless = dict[int, EndlessCoords]()
        self.read_s: float | None = None
        self._errors = dict[int, np.ndarray]()
        self._was = list[object]([None] * config.characters)
        self.rng = np.random.default_rng(config.seed)
        self.set_lead()

    def next(
        self, now_s: float
    ) -> tuple[Tensor, Tensor | None, tuple[Own | None, ...], dict[int, Tensor]]:
        """The poses that characters are to take in the control step at `now_s`.

        Returns:
            frames: `(K, 7 + n)`, the newest that the goals know.
            places: `(K, B, 3)` m of the bodies, NaN where the frames tell them; None where they all do.
            own: the people's poses that the frames are.
            more: of characters that are told one more, the frame that follows.
        """
        reads = self._reads(now_s)
        every = (self._frame(k, reads) for k in range(self.world.count))
        frames, places, own = zip(*every, strict=True)
        more = {k: frame for k in self.endless if (frame := self._one_more(k)) is not None}
        if all(p is None for p in places):
            return torch.stack(frames), None, own, more
        out = torch.full((self.world.count, len(self.world.humanoid.bodies), 3), torch.nan)
        for k, told in enumerate(places):
            if told is not None:
                out[k] = torch.from_numpy(told)
        return torch.stack(frames), out, own, more

    def _one_more(self, k: int) -> Tensor | None:
        """The frame that follows the newest of character k's endless motion, where its goal is to be
        told it."""
        character = self.world.characters[k]
        if not (character.goes_on and self.world.wants(k)):
            return None
        made = self.endless[k].next(False, self._others(k))
        return character.passed(tensor(self._noisy(k, made)[0]))

    def _reads(self, now_s: float) -> float:
        """When people are read: a step later than the last time, whenever the step comes, so that a slow
        machine makes slow motion and no leaps; what is behind is caught up with gently."""
        period, read = 1.0 / self.world.rate_hz, self.read_s
        if read is None or abs(now_s - read) > GIVES_UP_S:
            read = now_s
        else:
            share = 0.1 * (now_s - read - period) / period
            read += period * (1.0 + min(max(share, -CATCHES_UP), CATCHES_UP))
        self.read_s = read
        return read

    def _frame(self, k: int, now_s: float) -> tuple[Tensor, np.ndarray | None, Own | None]:
        """The newest frame that character k's goal knows, where its bodies are, if that is told, and the
        person's pose that it is."""
        world, person = self.world, self.people.of(k)
        character, endless = world.characters[k], self.endless.get(k)
        qpos, own, places, stalled = None, None, None, False
        follows = endless or self.people.follows[k]
        if self._was[k] != follows:
            self._was[k] = follows
            character.blend()
        if endless is not None:
            made = endless.next(character.comes, self._others(k), self._here(k))
            qpos = tensor(self._noisy(k, made)[0])
        elif person is not None and person.ready() and person.onto is not None:
            pose = person.read(now_s + 1.0 / world.rate_hz)
            if pose is not None:
                if pose.jumped:
                    character.jump()
                stalled = pose.stalled
                onto = person.onto
                if pose.places is not None:
                    places = onto.where.points(pose.places)
                made, places = self._noisy(k, onto(pose.root_pos, pose.rot), places)
                qpos, where = tensor(made), replace(onto.where)
                own = Own(onto.passage.source, pose.root_pos, pose.rot, where, onto.scale)
        frame = character.next(qpos, world.body(k), stalled)
        if character.moved is not None:
            # Its motion goes on from elsewhere.
            seen, to = (x.numpy() for x in character.moved)
            if endless is not None:
                endless.move(seen, to)
            elif person is not None and person.onto is not None:
                person.onto.where.move(seen, to)
        return (frame, places, own) if frame is qpos else (frame, None, None)

    def _others(self, k: int) -> list[np.ndarray]:
        """`(m, 3)` m each, where other characters than k are in the next frames."""
        out = list[np.ndarray]()
        for j, character in enumerate(self.world.characters):
            endless = self.endless.get(j)
            if j != k and endless is not None and character.doing not in (FALLS, RETURNS):
                out.append(endless.coming())
            elif j != k:
                out.append(self.world.body(j).qpos[None, :3].numpy())
        return out

    def _here(self, k: int) -> CharacterHere | None:
        """Character k, where it is on its motion."""
        if not self.world.characters[k].goes_on:
            return None
        qpos = self.world.body(k).qpos.numpy()
        return CharacterHere(qpos, self.world.lead[k], partial(self._now, k))

    def _now(self, k: int) -> CharacterNow:
        goal, ids = self.world.goal, torch.tensor([k])
        index = torch.arange(int(goal.at[k]) - 1, int(goal.count[k]))
        frames = goal.coordinates(ids.expand(len(index)), index)[0]
        return CharacterNow(SnapshotArrays.of(self.world.env.snapshot(ids)), frames.numpy())

    def _noisy(
        self, k: int, qpos: np.ndarray, places: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Coordinates `(7 + n)` and places `(B, 3)` with errors."""
        size = self.noise
        if size:
            # x' = a x + sqrt(1 - a^2) e: errors that wander, as those of estimators do.
            a = np.exp(-1.0 / (WANDERS_S * self.world.rate_hz))
            width = len(qpos) + (0 if places is None else places.size)
            drawn = self.rng.normal(0.0, 1.0, width)
            old = self._errors.get(k, drawn)
            old = old if len(old) == width else drawn
            wander = self._errors[k] = a * old + np.sqrt(1.0 - a * a) * drawn
            n = len(qpos)
            qpos[7:] += 0.1 * size * wander[7:n]
            qpos[:3] += 0.03 * size * wander[:3]
            if places is not None:
                places = places + 0.03 * size * wander[n:].reshape(places.shape)
        return qpos, places

    @property
    def lead(self) -> int:
        """How many frames goals are behind what is read, by the length of the buffer."""
        delay = self.people.delay_s
        return 1 + int((delay - margin(delay)) * self.world.rate_hz + 1e-6)

    def set_lead(self) -> None:
        """Lets the length of the buffer count."""
        for k in range(self.world.count):
            if k not in self.endless:
                self.world.set_lead(k, self.lead)

    def dream(self, k: int, on: bool) -> None:
        """A character begins endless motion, or goes back to its person."""
        if not on:
            if self.endless.pop(k, None) is not None:
                self.world.set_lead(k, self.lead, grows=True)
        elif self.generator is not None and k not in self.endless:
            seed = int(self.rng.integers(2**31))
            g, ease = self.generator, self.world.characters[k].get_up.recovery_clips.ease.numpy()
            self.endless[k] = EndlessCoords(self._ask, ease, g.past, g.future, g.fps, seed)
            # Endless motion is known as far ahead as the policy sees.
            self.world.set_lead(k, max((self.lead, *self.world.tracker.config.window)), grows=True)
        self.look_ahead(self.world.wanted)

    def _ask(self, asked: SegmentAsked) -> Future[SegmentMade]:
        """More endless motion: from a process of its own, another one where that has ended, or made at
        once."""
        if isinstance(self._maker, Beside) and self._maker.ended:
            self._maker.close()
            self._maker = None
        if self._maker is None:
            assert self.generator is not None
            args = replace(self.world.tracker, about={}), self.generator
            beside = Beside[SegmentAsked, SegmentMade]
            self._maker = maker(*args) if self._executor is None else beside(maker, args, NICE)
        if isinstance(self._maker, Beside):
            return self._maker.ask(asked._replace(by_s=time.time() + asked.spare_s))
        made: Future[SegmentMade] = Future()
        made.set_result(self._maker(asked))
        return made

    def look_ahead(self, characters: tuple[int, ...]) -> None:
        """Lets characters look ahead. Several on endless motion do not: their futures are tried with the
        policy alone, and that takes the time."""
        self.world.look_ahead(characters, self.endless if len(self.endless) > 1 else ())

    def close(self) -> None:
        """Frees what makes endless motion."""
        if isinstance(self._maker, Beside):
            self._maker.close()
        elif self._maker is not None:
            self._maker.trials.copies.close()


def maker(tracker: Tracker, generator: Kinematic) -> SegmentMaker:
    """Makes endless motion for all characters, one after another."""
    trials = trials_of(tracker, generator, TRIES)
    trials.copies.record_at_once()
    return SegmentMaker(generator, trials)
