"""Characters of one policy in one world, each with a stream for a goal; they can be pushed, and a ball
can be thrown at them. Compliance feels the hand that drags a body, and blows.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.control import Compliance
from poise.env.events import Felt, Force
from poise.env.goal import Goal
from poise.env.recovery.get_up import GetUpPlanner
from poise.env.stream_goal import StreamGoal
from poise.env.yielding import Yielding
from poise.errors import PoiseError
from poise.jobs.track.placement import place
from poise.jobs.track.tracking import imitation_of
from poise.jobs.tracker import Tracker
from poise.live.characters import FALLS, CharacterGoals, CharacterState
from poise.live.lookahead_process import AheadAtOnce, AheadBeside
from poise.live.people import Own
from poise.sim import Backend, CharacterRows, Drive, Scene, SceneSim, alone
from poise.sim import Character as Actor
from poise.sim.props import Ball

#: N/m and N s/m of the hand that drags a body, and N that it exerts at most.
PULL, DAMP, MOST_N = 400.0, 40.0, 500.0
#: N s and s of a blow; it fells a walking character in 10 of 12 tries.
BLOW_NS, BLOW_S = 150.0, 0.1


class PushInput(Force):
    """One hand and one blow on each of K characters; their forces are held for a control step."""

    def __init__(self, goal: Goal, backend: Backend):
        self._backend, self._rate_hz = backend, goal.rate_hz
        self._chest = goal.humanoid.rows_of("spine")[-1] + 1
        k = backend.num_envs
        self._body = torch.zeros(k, 2, dtype=torch.long)
        self._point, self._force = (torch.zeros(k, 2, 3, dtype=torch.float64) for _ in range(2))
        self.pulls = dict[int, tuple[int, Tensor, Tensor]]()
        self._blows = dict[int, tuple[Tensor, int]]()

    def pull(self, character: int, body: int, point: np.ndarray, to: np.ndarray) -> None:
        """A hand holds a body at `point (3)` m in its frame and draws it to `to (3)` m in the world."""
        double = torch.float64
        self.pulls[character] = body, torch.tensor(point, dtype=double), torch.tensor(to, dtype=double)

    def let_go(self, character: int) -> None:
        """The hand lets go."""
        self.pulls.pop(character, None)

    def blow(self, character: int, direction: np.ndarray) -> None:
        """A blow on the chest along `direction (3)`, `BLOW_NS` N s."""
        force = torch.tensor(direction / max(float(np.linalg.norm(direction)), 1e-9)) * BLOW_NS / BLOW_S
        self._blows[character] = force, max(1, round(BLOW_S * self._rate_hz))

    def before_step(self, drive: Drive) -> bool:
        """Adds what pulls and strikes."""
        self._force.zero_()
        state = self._backend.state
        for k, (body, point, to) in self.pulls.items():
            pos, quat = state.xpos[k, body + 1].double(), state.xquat[k, body + 1].double()
            vec, w = quat[1:], quat[0]
            t = 2.0 * torch.linalg.cross(vec, point)
            held = pos + point + w * t + torch.linalg.cross(vec, t)
            force = PULL * (to - held) - DAMP * state.qvel[k, :3].double()
            force = force * min(1.0, MOST_N / max(float(force.norm()), 1e-9))
            self._put(drive, k, 0, body + 1, held, force)
        for k, (force, left) in list(self._blows.items()):
            self._put(drive, k, 1, self._chest, state["xipos"][k, self._chest].double(), force)
            if left > 1:
                self._blows[k] = force, left - 1
            else:
                del self._blows[k]
        return False

    def felt(self) -> Felt:
        """The forces of this control step."""
        return Felt(self._body, self._point, self._force)

    def _put(self, drive: Drive, k: int, slot: int, row: int, at: Tensor, force: Tensor) -> None:
        arm = at - self._backend.state["xipos"][k, row].double()
        wrench = torch.cat((force, torch.linalg.cross(arm, force)))
        drive.xfrc_applied[k, row] += wrench.to(drive.xfrc_applied)
        self._body[k, slot], self._point[k, slot], self._force[k, slot] = row, at, force


#: m between characters at first, and where the ball waits.
APART_M, AWAY = 2.0, (0.0, 400.0, 0.15)
#: m/s of the ball when it comes.
BALL_MPS = 4.0


class LiveStep(NamedTuple):
    """A control step, for the page and the sinks.

    Attributes:
        step: its number. time_s: simulated time.
        doing: what each character does.
        bodies: `(K, B, 7)` m and wxyz of each character.
        goals: `(K, B, 7)` of what each was to do.
        ball: `(7)`.
        qpos: `(K, 7 + n)`.
        off_m: `(K)` m, between body and goal on average.
        own: of each the person's pose that its goal is now; None where it follows something else.
    """

    step: int
    time_s: float
    doing: tuple[str, ...]
    bodies: np.ndarray
    goals: np.ndarray
    ball: np.ndarray
    qpos: np.ndarray
    off_m: np.ndarray
    own: tuple[Own | None, ...]


#: Steps of which it is kept what was read; goals are fewer behind.
READ = 16


class LiveWorld:
    """K characters that follow streams, without help.

    Args:
        tracker: the policy, which must have learned to get up.
        count: K.
        executor: plans recovery motions beside the loop; None plans at once.
        lookahead: characters that look ahead.
        beside: whether that is done in a process of its own; else at once, as tests do.

    Attributes:
        characters: what each is to do.
        hands: what pushes them.
        yielding: their dials of compliance.
        lead: frames by which each one's goal is behind the newest that is known.
        resets: how often the simulation went bad and all were set down anew.
        unwound: how often a fallen character's hinges were whole turns off.
        hurries: whether there is no time to look ahead; all act at once then.
        looked: control steps in which a character looked ahead.
        wanted: characters that are to look ahead, and `ahead_of`, those of them that do.
        ahead: looks ahead for those that do; None before one does.

    Raises:
        PoiseError: a policy that cannot get up, or has no critic though it is to look ahead.
    """

    def __init__(
        self,
        tracker: Tracker,
        count: int = 1,
        executor: Executor | None = None,
        lookahead: tuple[int, ...] = (),
        seed: int = 0,
        beside: bool = False,
    ):
        if tracker.recovery_clips is None:
            raise PoiseError(
                "the policy has not learned to get up, which live motion needs",
                hint="Train one on a library with a clip that gets up",
                code="recovery-not-learned",
            )
        self.tracker, self.count = tracker, count
        task = imitation_of(tracker, [place(tracker.example, tracker)]).bare()
        # The dials begin at 0, where nothing gives way.
        yields = Compliance(level=0.0)
        own = replace(task.task, help_by="all", compliance=yields, events=(PushInput,))
        task = replace(task, task=own)
        body, sim = task.humanoid, task.config.sim
        self.humanoid, self.rate_hz = body, sim.control_hz
        names = ("", *(str(k + 1) for k in range(1, count)))
        things = (*(Actor(body, name) for name in names), Ball(mass=4.0, pos=AWAY))
        self.scene = SceneSim(Scene(things, sim=sim), 1, threads=1)
        places = [self.scene.scene.place(n) for n in names]
        # Snapshots are of a character alone, so that lookahead can try with it.
        self.rows = CharacterRows(self.scene.backend, places, alone(body, sim), self.scene)
        self.env = task.env(auto_reset=False, help_scale=0.0, guard=False, backend=self.rows)
        self.env.record_at_once()
        hands, yielding = self.env.event(PushInput), self.env.event(Yielding)
        assert hands is not None and yielding is not None
        self.hands, self.yielding = hands, yielding
        self.goal = StreamGoal(body, self.rate_hz, count, seed=seed)
        planner = GetUpPlanner(tracker.recovery_clips, body.table, self.rate_hz)
        wide = int(np.ceil(np.sqrt(count)))
        spots = [(APART_M * (k // wide), APART_M * (k % wide)) for k in range(count)]
        self.characters = [CharacterGoals(planner, spot, executor) for spot in spots]
        self.substeps, self.resets, self.steps, self.unwound = sim.substeps, 0, 0, 0
        self._range = torch.from_numpy(body.model.jnt_range[1:].T.copy()).to(self.rows.state.qpos)
        self.lead, self._full = [1] * count, [1] * count
        self._read = [deque[Own | None](maxlen=READ) for _ in range(count)]
        self.hurries, self.looked = False, 0
        self._act = tracker.policy.act
        self.ahead: AheadAtOnce | AheadBeside | None = None
        self._beside, self._seed = beside, seed
        if lookahead and tracker.value is None:
            raise PoiseError(
                "the policy was saved without its critic, which lookahead needs", code="critic-missing"
            )
        self._set_down()
        self.look_ahead(lookahead)

    def look_ahead(self, characters: tuple[int, ...], but: Collection[int] = ()) -> None:
        """Lets characters look ahead, `but` some; the others act at once."""
        self.wanted = tuple(k for k in characters if 0 <= k < self.count)
        self.ahead_of = tuple(k for k in self.wanted if k not in but)
        if self.ahead is None and self.ahead_of and self.can_look_ahead:
            self.ahead = (AheadBeside if self._beside else AheadAtOnce)(self.tracker, self._seed)
        if self.ahead is not None:
            self.ahead.watch(self.env, self.ahead_of)

    @property
    def can_look_ahead(self) -> bool:
        """Whether the policy has a critic."""
        return self.tracker.value is not None

    def _set_down(self) -> None:
        frames = torch.stack([c.ease for c in self.characters])
        self.set_on(frames, torch.zeros(self.count, self.humanoid.model.nv, dtype=torch.float64))

    def set_on(self, frames: Tensor, qvel: Tensor) -> None:
        """Sets all characters down on frames `(K, 7 + n)`, moving with `qvel (K, 6 + n)`."""
        every = torch.arange(self.count)
        for c, frame in zip(self.characters, frames, strict=True):
            c.begin(frame)
        self.goal.clear(every)
        self.goal.push(frames)
        self.goal.reset(every)
        self.env.backend.write(None, frames, qvel)
        self.env.age[:] = 0
        self.env.set_goal(self.goal)
        self._off, self._speed = np.zeros(self.count), np.zeros(self.count)
        self._moves = torch.zeros(self.count, 2, dtype=torch.float64)

    # --- what is done to them -----------------------------------------------------------------

    def comply(self, character: int, level: float) -> None:
        """Turns a character's dial of compliance, 0 to 1."""
        self.yielding.turn(level, torch.tensor([character]))

    def drop_ball(self, character: int) -> None:
        """The ball flies at a character's chest from 2 m before it."""
        q = self.rows.state.qpos[character]
        w, x, y, z = q[3:7].tolist()
        angle = np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
        ahead = torch.tensor([np.cos(angle), np.sin(angle), 0.0], dtype=torch.float64)
        pos = q[:3].double() + 2.0 * ahead + torch.tensor([0.0, 0.0, 0.45], dtype=torch.float64)
        qpos = torch.cat((pos, torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)))
        qvel = torch.cat((-BALL_MPS * ahead, torch.zeros(3, dtype=torch.float64)))
        qvel[2] = 1.5
        self.scene.place("ball", qpos[None], qvel[None])
        self.rows.pull()

    # --- stepping -----------------------------------------------------------------------------

    def body(self, character: int) -> CharacterState:
        """Where a character is."""
        return CharacterState(
            self.rows.state.qpos[character].double(),
            float(self._off[character]),
            float(self._speed[character]),
            self._moves[character],
        )

    def set_lead(self, character: int, lead: int, grows: bool = False) -> None:
        """By how many frames a character's goal is behind the newest ones; it `grows` so bit by bit."""
        self._full[character] = lead
        if not grows:
            self.lead[character] = lead

    def wants(self, character: int) -> bool:
        """Whether its goal is less behind than it is to be, so that it may be told one frame more."""
        return self.lead[character] < self._full[character]

    def _lead_on(self) -> None:
        """A motion that begins from where a body is has nothing before it, and counts at once; what lies
        ahead of it grows again while it stands still."""
        for k, character in enumerate(self.characters):
            if character.anew:
                self.goal.clear(torch.tensor([k]))
                self.lead[k] = 1
            elif character.still:
                self.lead[k] = min(self._full[k], self.lead[k] + 1)
            elif self.lead[k] > self._full[k] and self.steps % 2:
                # Known frames go by faster until the goal is behind no more.
                self.lead[k] -= 1

    def step(
        self,
        frames: Tensor,
        places: Tensor | None = None,
        own: Sequence[Own | None] = (),
        more: Mapping[int, Tensor] | None = None,
    ) -> LiveStep:
        """One control step toward the frames `(K, 7 + n)`, the newest that the goals know.

        places: see `StreamGoal.push`. own: the people's poses that the frames are. more: of some
            characters the frame that follows, for those that `wants`.
        """
        env, goal = self.env, self.goal
        self._lead_on()
        goal.push(frames, places=places)
        for read, pose in zip(self._read, own or [None] * self.count, strict=True):
            read.append(pose)
        for k, frame in (more or {}).items():
            goal.push(frame, torch.tensor([k]))
            self._read[k].append(None)
            self.lead[k] += 1
        lead = torch.tensor(self.lead)
        goal.at.copy_((goal.count - 1 - lead).clamp_min(0))
        goal.aim(None, None)
        goal.notes.clear()
        obs = env.observe()
        ahead = self.ahead if self.ahead_of and not self.hurries else None
        if self.ahead is not None and ahead is None:
            self.ahead.skip()
        env.drive(self._act(obs) if ahead is None else ahead.act(obs))
        self.looked += ahead is not None and ahead.acts
        env.controls.step(env.backend, self.substeps)
        # Nothing is rewarded, and the goal is moved above: a third of a step's time less.
        env.tick()
        goal.at += 1
        goal.aim(None, None)
        self.steps += 1
        self.unwind()
        if bool(self.rows.unstable().any()) or not bool(self.rows.state.qpos.isfinite().all()):
            self.resets += 1
            self._set_down()
        return self._seen()

    def unwind(self) -> None:
        """Whole turns that a fall has made of a hinge are left out: the pose is the same, and nothing is
        turned back all round where the character gets up."""
        state = self.rows.state
        for k, character in enumerate(self.characters):
            if character.doing != FALLS:
                continue
            hinges = state.qpos[k, 7:]
            turns = 2 * torch.pi * ((hinges - character.ease[7:].to(hinges)) / (2 * torch.pi)).round()
            low, high = self._range
            turns[(hinges - turns < low) | (hinges - turns > high)] = 0.0
            if bool(turns.any()):
                qpos = state.qpos[k].clone()
                qpos[7:] -= turns
                self.unwound += 1
                self.rows.write(torch.tensor([k]), qpos[None], state.qvel[k].clone()[None])

    def _seen(self) -> LiveStep:
        pose, goal, state = self.env.here(), self.env.goal_pose(), self.scene.backend.state
        self._off = (pose.pos - goal.pos).norm(dim=-1).mean(-1).double().numpy()
        self._speed = pose.linvel.norm(dim=-1).mean(-1).double().numpy()
        self._moves = pose.linvel[:, 0, :2].double()
        at = self.scene.scene.place("ball").qpos
        bodies, goals = (torch.cat((p.pos, p.quat), -1).float().numpy().copy() for p in (pose, goal))
        ball = state.qpos[0, at].float().numpy().copy()
        qpos = self.rows.state.qpos.double().numpy().copy()
        read = zip(self._read, self.lead, strict=True)
        own = tuple(poses[-back] if len(poses) >= back else None for poses, back in read)
        doing = tuple(c.doing for c in self.characters)
        at_s, off = self.steps / self.rate_hz, self._off
        return LiveStep(self.steps, at_s, doing, bodies, goals, ball, qpos, off, own)

    def close(self) -> None:
        """Frees the simulations."""
        self.env.close()
        if self.ahead is not None:
            self.ahead.close()
