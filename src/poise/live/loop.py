"""The loop: 30 times a second what came becomes goals, goals become actions, actions become motion.

It never waits. Sources put packets into an `Inbox`, pages put commands into a bounded queue, and what a
step came to goes to those that show or keep it, each of which takes the newest when it can.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.jobs.tracker import Tracker
from poise.live.buffer import MARGIN_S
from poise.live.calibration import OntoBody, calibrated
from poise.live.character import FALLS, RETURNS, tensor
from poise.live.endless import Endless
from poise.live.packet import Inbox, Packet
from poise.live.people import STAND, People
from poise.live.sinks.vmc import Own
from poise.live.world import Seen, World
from poise.motion import Clip
from poise.settings import validate
from poise.synth.generator import Kinematic

#: Commands that wait at most, and steps of which figures are made.
COMMANDS, STEPS = 256, 1800
#: s after which a hand that says nothing more has let go.
HOLDS_S = 1.0
#: Share by which motion is faster or slower while what is behind is caught up with, and s behind which
#: nothing is caught up with.
CATCHES_UP, GIVES_UP_S = 0.15, 1.5
#: Steps of which it is kept what was read; goals are fewer behind.
READ = 16
#: s in which errors wander.
WANDERS_S = 0.3
#: s for which no character looks ahead after a step that came too late.
HURRIES_S = 2.0


@dataclass(frozen=True)
class LiveConfig:
    """How live motion is followed.

    Attributes:
        characters: in one world.
        buffer_s: s, 0 to 0.4: evens out how packets come; what of it exceeds 0.05 s is known ahead. With
            0 the goal is extrapolated.
        lookahead: how many characters look ahead before they act, the first ones.
        noise: 0 to 1, what is added to goals as a video estimator errs: 0.1 rad and 30 mm for 1,
            which wander within 0.3 s.
        seed: of the noise and of lookahead.
    """

    characters: int = 1
    buffer_s: float = 0.1
    lookahead: int = 0
    noise: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        validate(self)
        if not 1 <= self.characters <= 16:
            raise PoiseError(f"characters must lie in 1 to 16, got {self.characters}", "LiveConfig")
        if not 0 <= self.buffer_s <= 0.4:
            raise PoiseError(f"buffer_s must lie in 0 to 0.4 s, got {self.buffer_s:g}", "LiveConfig")
        if not 0 <= self.lookahead <= self.characters:
            what = f"lookahead must lie in 0 to {self.characters} characters, got {self.lookahead}"
            raise PoiseError(what, "LiveConfig")
        if not 0 <= self.noise <= 1:
            raise PoiseError(f"noise must lie in 0 to 1, got {self.noise:g}", "LiveConfig")


class Shows(Protocol):
    """What a step's outcome goes to; it returns at once."""

    def show(self, seen: Seen, live: Live) -> None:
        """Takes a control step."""
        ...


class Live:
    """The world, the people, and the clock.

    Args:
        inbox: where sources put packets.
        shows: what steps go to.
        executor: calibrates and plans beside the loop; None does it at once, as tests do.
        clock: s; the clock by which packets arrive.
        generator: makes endless motion; None: there is none.

    Attributes:
        commands: what pages want, see `poise.live.commands`.
        paused: whether physics waits.
        behind: control steps that came too late.
    """

    def __init__(
        self,
        tracker: Tracker,
        config: LiveConfig | None = None,
        inbox: Inbox | None = None,
        shows: Sequence[Shows] = (),
        executor: Executor | None = None,
        clock: Callable[[], float] = time.perf_counter,
        generator: Kinematic | None = None,
    ):
        self.config = c = config or LiveConfig()
        self.tracker, self.inbox, self.shows = tracker, inbox or Inbox(), list(shows)
        self.world = World(tracker, c.characters, executor, tuple(range(c.lookahead)), c.seed)
        self.people = People(c.characters, c.buffer_s, self._calibration, executor)
        for k, character in enumerate(self.world.characters):
            character.on_move(lambda seen, to, k=k: self._moved(k, seen, to))
        self.rate_hz, self.clock = self.world.rate_hz, clock
        self.commands: deque[dict[str, Any]] = deque(maxlen=COMMANDS)
        self.paused, self.behind, self.steps = False, 0, 0
        self._read: float | None = None
        self.generator, self._executor = generator, executor
        self.endless = dict[int, Endless]()
        self._hurry, self._errors = 0, dict[int, np.ndarray]()
        #: What was read of each character's person in the last steps; None where the goal is another.
        self.read = [deque[Own | None](maxlen=READ) for _ in range(c.characters)]
        self.recording: Callable[[bool], None] | None = None
        self._rng = np.random.default_rng(c.seed)
        self._latency: deque[float] = deque(maxlen=STEPS)
        self._spent: deque[float] = deque(maxlen=STEPS)
        self._began: deque[float] = deque(maxlen=90)
        self._pulled: dict[int, float] = {}
        self._was = list[object]([None] * c.characters)
        self._set_lead()

    # --- steps --------------------------------------------------------------------------------

    def run(self, until: Callable[[], bool]) -> None:
        """Steps in real time until `until()`; a step that comes late is not made up for."""
        period = 1.0 / self.rate_hz
        due = self.clock()
        while not until():
            now = self.clock()
            if now < due:
                time.sleep(min(due - now, 0.05))
                continue
            if now - due > period:
                self.behind += int((now - due) / period)
                due = now
                # Better in time than far-sighted.
                self._hurry = self.steps + round(HURRIES_S * self.rate_hz)
            due += period
            self.step(now)

    def step(self, now_s: float) -> Seen | None:
        """One control step at `now_s`; None while paused."""
        began = self.clock()
        packets = self.inbox.take()
        self.people.add(packets)
        self._obey(now_s)
        if self.paused:
            return None
        reads = self._reads(now_s)
        frames = torch.stack([self._frame(k, reads) for k in range(self.config.characters)])
        self.world.hurries = self.steps < self._hurry
        seen = self.world.step(frames)
        self.steps += 1
        if self.steps % 30 == 0:
            self.people.tidy(now_s)
        for show in self.shows:
            show.show(seen, self)
        done = self.clock()
        self._spent.append(done - began)
        self._began.append(began)
        self._latency += [done - arrived for line in packets.values() for arrived, _ in line[-1:]]
        return seen

    def _reads(self, now_s: float) -> float:
        """When people are read: a step later than the last time, whenever the step comes, so that a slow
        machine makes slow motion and no leaps; what is behind is caught up with gently."""
        period, read = 1.0 / self.rate_hz, self._read
        if read is None or abs(now_s - read) > GIVES_UP_S:
            read = now_s
        else:
            share = 0.1 * (now_s - read - period) / period
            read += period * (1.0 + min(max(share, -CATCHES_UP), CATCHES_UP))
        self._read = read
        return read

    def _frame(self, k: int, now_s: float) -> Tensor:
        """The newest frame that character k's goal knows."""
        character, person = self.world.characters[k], self.people.of(k)
        endless, qpos, own = self.endless.get(k), None, None
        follows = endless or self.people.follows[k]
        if self._was[k] != follows:
            self._was[k] = follows
            character.blend()
        if endless is not None:
            made = endless.next(character.doing in (FALLS, RETURNS))
            qpos = None if made is None else tensor(self._noisy(k, made))
        elif person is not None and person.ready() and person.onto is not None:
            pose = person.read(now_s + 1.0 / self.rate_hz)
            if pose is not None:
                if pose.jumped:
                    character.jump()
                qpos = tensor(self._noisy(k, person.onto(pose.root_pos, pose.rot)))
                onto = person.onto
                where = replace(onto.where)
                own = Own(onto.passage.source, pose.root_pos, pose.rot, where, onto.scale)
        frame = character.next(qpos, self.world.body(k), self.world.lead[k])
        self.read[k].append(own if frame is qpos else None)
        return frame

    def own(self, k: int) -> Own | None:
        """The person's pose that character k's goal is now; None where it follows something else."""
        read, back = self.read[k], self.world.lead[k]
        return read[-back] if len(read) >= back else None

    def _noisy(self, k: int, qpos: np.ndarray) -> np.ndarray:
        size = self.config.noise
        if size:
            # x' = a x + sqrt(1 - a^2) e: errors that wander, as those of estimators do.
            a = np.exp(-1.0 / (WANDERS_S * self.rate_hz))
            drawn = self._rng.normal(0.0, 1.0, len(qpos))
            self._errors[k] = a * self._errors.get(k, drawn) + np.sqrt(1.0 - a * a) * drawn
            qpos[7:] += 0.1 * size * self._errors[k][7:]
            qpos[:3] += 0.03 * size * self._errors[k][:3]
        return qpos

    def _calibration(self, packet: Packet, clip: Clip) -> OntoBody | str:
        t = self.tracker
        ease = t.recovery_clips.ease.numpy() if t.recovery_clips is not None else np.zeros(0)
        return calibrated(packet, clip, t.humanoid, t.example, ease, t.onto)

    def _moved(self, k: int, seen: Tensor, to: Tensor) -> None:
        person = self.people.of(k)
        if k in self.endless:
            self.endless[k].move(seen.numpy(), to.numpy())
        elif person is not None and person.onto is not None:
            person.onto.move(seen.numpy(), to.numpy())

    def _set_lead(self) -> None:
        lead = 1 + int(max(0.0, self.people.delay_s - MARGIN_S) * self.rate_hz + 1e-6)
        self.world.lead = [lead] * self.config.characters

    # --- commands -----------------------------------------------------------------------------

    def _obey(self, now_s: float) -> None:
        while self.commands:
            self._do(self.commands.popleft(), now_s)
        for k in [k for k, t in self._pulled.items() if now_s - t > HOLDS_S]:
            del self._pulled[k]
            self.world.hands.let_go(k)

    def _do(self, command: dict[str, Any], now_s: float) -> None:
        """A command that was checked, see `poise.live.commands`."""
        kind, k = command["type"], int(command.get("character", 0))
        if k >= self.config.characters:
            return
        if kind == "pull":
            if command["body"] < len(self.world.humanoid.bodies):
                self.world.hands.pull(
                    k, command["body"], np.array(command["point"]), np.array(command["to"])
                )
                self._pulled[k] = now_s
        elif kind == "release":
            self._pulled.pop(k, None)
            self.world.hands.let_go(k)
        elif kind == "knock":
            angle = self._rng.uniform(0, 2 * np.pi)
            self.world.hands.blow(k, np.array([np.cos(angle), np.sin(angle), 0.0]))
        elif kind == "ball":
            self.world.drop_ball(k)
        elif kind == "comply":
            self.world.comply(k, command["level"])
        elif kind == "dream":
            self._dream(k, command["on"])
        elif kind == "pause":
            self.paused = command["on"]
        elif kind == "follow":
            self.people.switch(k, command["person"])
        elif kind == "record" and self.recording is not None:
            self.recording(command["on"])
        elif kind == "set":
            self._set(command)

    def _dream(self, k: int, on: bool) -> None:
        """A character begins endless motion, or goes back to its person."""
        if not on:
            self.endless.pop(k, None)
        elif self.generator is not None and k not in self.endless:
            seed = int(self._rng.integers(2**31))
            self.endless[k] = Endless(self.generator, seed, self._executor)

    def _set(self, command: dict[str, Any]) -> None:
        if "buffer" in command:
            self.people.delay(command["buffer"])
            self._set_lead()
        if "noise" in command:
            self.config = replace(self.config, noise=command["noise"])
        if "lookahead" in command:
            most = min(command["lookahead"], self.config.characters)
            self.world.look_ahead(tuple(range(most if self.world.can_look_ahead else 0)))

    # --- figures ------------------------------------------------------------------------------

    def figures(self) -> dict[str, Any]:
        """What is shown beside the characters; times in ms, over the last minute."""
        late, spent = self._latency, self._spent
        began, people = self._began, self.people
        span = began[-1] - began[0] if len(began) > 1 else 0.0
        return {
            "hz": round((len(began) - 1) / span, 1) if span > 0 else 0.0,
            "latency_ms": _percentiles(late), "step_ms": _percentiles(spent), "behind": self.behind,
            "buffer": people.delay_s, "noise": self.config.noise, "lookahead": len(self.world.ahead_of),
            "looked_ahead": round(self.world.looked / max(1, self.steps), 3), "paused": self.paused,
            "resets": self.world.resets, "help_n": 0.0, "received": self.inbox.received,
            "refused": dict(self.inbox.refused), "crowded": self.inbox.crowded,
            "people": [
                {"name": p.name, "calibrated": round(p.share, 2), "said": "" if p.onto else p.said}
                for p in people.known.values()
            ]
            + [
                {"name": name, "calibrated": round(share, 2), "said": STAND}
                for name, share in list(self.inbox.standing.items())
            ],
            "characters": [self._figures(k) for k in range(self.config.characters)],
        }  # fmt: skip

    def _figures(self, k: int) -> dict[str, Any]:
        c, world = self.world.characters[k], self.world
        return {
            "follows": self.people.follows[k], "doing": c.doing, "lost": c.lost, "falls": c.falls,
            "recovered": c.recovered, "off_mm": round(1000.0 * world.body(k).off_m),
            "compliance": round(float(world.yielding.level[k]), 3), "endless": k in self.endless,
        }  # fmt: skip

    def close(self) -> None:
        """Frees the simulations."""
        self.world.close()


def _percentiles(seconds: deque[float]) -> list[float]:
    """ms that half of them, and 99 % of them, are below."""
    kept = np.array(seconds) * 1000.0 if seconds else np.zeros(1)
    return [round(float(np.percentile(kept, p)), 1) for p in (50, 99)]
