"""The environment: many worlds, what each is to do, a list of terms; and its worlds, copied."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import torch
from torch import Tensor

from poise.control import Wrench
from poise.env import frame as observables
from poise.env.controls import Controls
from poise.env.evaluate import Sources, Terms, seen_by
from poise.env.events import BodyAssignment, EpisodeStart, Event, StepOutcome
from poise.env.frame import FIELDS, Frame, Pose, placed
from poise.env.goal import Goal
from poise.env.recovery.clock import RecoveryClock
from poise.env.reference import Reference
from poise.env.style import ClipFeatures, ClipWindows
from poise.env.task import EnvStep, StepLog, TaskConfig, displaced_goal, events_of, goal_of
from poise.env.yielding import DisplacedGoal, Yielding
from poise.errors import PoiseError
from poise.machine import one_thread
from poise.sim import Backend, NanGuard


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What n worlds were, see `ImitationEnv.snapshot`.

    Attributes:
        worlds: tensors `(n, ...)` by name: physics "sim", and its "qpos" and "qvel" for another kind of
            backend; the goal's and the events' rows, "age", "action", ...
        physics: width of the physics without derived fields, the first columns of "sim".
        goal: what the goal's rows point into.
        shared: what all worlds of the environment share: help, failure rates, odds, random generators;
            None where only some of its worlds were copied.
    """

    worlds: Mapping[str, Tensor]
    physics: int
    goal: Mapping[str, Tensor]
    shared: Mapping[str, Tensor] | None

    def __len__(self) -> int:
        return len(self.worlds["sim"])

    def repeated(self, count: int) -> Snapshot:
        """A snapshot of one world as one of `count` worlds."""
        many = {k: v.expand(count, *v.shape[1:]) for k, v in self.worlds.items()}
        return Snapshot(many, self.physics, self.goal, None)

    def picked(self, rows: Tensor) -> Snapshot:
        """The worlds `rows (k,)` of this snapshot, each as often as it is named."""
        return Snapshot({k: v[rows] for k, v in self.worlds.items()}, self.physics, self.goal, None)


def take(env: ImitationEnv, rows: Tensor | None) -> Snapshot:
    """What worlds `rows (n,)` of an environment are, all for None: physics, bodies, goal, episode,
    recovery; and of all worlds what they share: help, failure rates, odds, random generators."""
    state = env.backend.state
    worlds = {"sim": env.backend.snapshot(), "qpos": state.qpos, "qvel": state.qvel, **_rows(env)}
    copies = {k: v.clone() if rows is None else v.index_select(0, rows) for k, v in worlds.items()}
    width = env.backend.snapshot(derived=False).shape[1]
    return Snapshot(copies, width, dict(env.goal.shared()), _shared(env) if rows is None else None)


def put(env: ImitationEnv, snapshot: Snapshot, rows: Tensor | None) -> None:
    """Makes worlds `rows (n,)` of an environment, all for None, what a snapshot holds; see
    `ImitationEnv.restore`, which aims their goals then."""
    count = env.num_envs if rows is None else len(rows)
    if len(snapshot) == 1 and count > 1:
        snapshot = snapshot.repeated(count)
    if len(snapshot) != count:
        raise PoiseError(
            f"the snapshot holds {len(snapshot)} worlds, and {count} are to be restored",
            code="count-differs",
        )
    into = _rows(env)
    missing = sorted(into.keys() - snapshot.worlds.keys())
    if missing:
        raise PoiseError(
            f"the snapshot of another kind of environment has no '{missing[0]}'", code="snapshot-differs"
        )
    env.goal.load_shared(snapshot.goal)
    for name, value in into.items():
        if rows is None:
            value.copy_(snapshot.worlds[name])
        else:
            value[rows] = snapshot.worlds[name]
    if env.bodies is not None:
        env.bodies.assign(rows, env.goal.clips.body(rows))
    sim, backend = snapshot.worlds["sim"], env.backend
    if sim.shape[1] == backend.snapshot().shape[1]:
        backend.restore(sim, rows)
    elif snapshot.physics == backend.snapshot(derived=False).shape[1]:
        # Other terms have other fields of the state fetched, which follow from the rest.
        backend.restore(sim[:, : snapshot.physics], rows)
    else:
        # Another kind of backend, such as a world of several characters.
        backend.write(rows, snapshot.worlds["qpos"], snapshot.worlds["qvel"])
    if rows is None and snapshot.shared is not None:
        for event in env.events:
            event.load_state(snapshot.shared)
        if "weights" in snapshot.shared:
            env.weights = snapshot.shared["weights"]
        env.goal.rng.set_state(snapshot.shared["rng"])


def state_of(env: ImitationEnv) -> dict[str, Tensor]:
    """Everything that a bit-exact continuation of an environment needs."""
    return {
        "sim": env.backend.snapshot(),
        "qpos": env.backend.state.qpos.clone(),
        "qvel": env.backend.state.qvel.clone(),
        "age": env.age.clone(),
        "action": env.action.clone(),
        **{k: v.clone() for k, v in env.controls.rows().items()},
        **env.goal.state(),
        **{k: v for event in env.events for k, v in event.state().items()},
    }


def put_state(env: ImitationEnv, state: Mapping[str, Tensor]) -> None:
    """Makes an environment what `state_of` told; see `ImitationEnv.load_state`."""
    env.goal.load_state(state)
    if env.bodies is not None:
        env.bodies.assign(None, env.goal.clips.body(None))
    if state["sim"].dtype == env.backend.state.qpos.dtype:
        env.backend.restore(state["sim"])
    else:
        env.backend.write(None, state["qpos"], state["qvel"])
    own = {"age": env.age, "action": env.action, **env.controls.rows()}
    for name, value in own.items():
        value.copy_(state[name])
    for event in env.events:
        event.load_state(state)
    if env.goal.begins:
        env.weights = env.weights


def _rows(env: ImitationEnv) -> dict[str, Tensor]:
    """The tensors `(N, ...)` of an environment beside its physics, by name."""
    goal = {f"goal/{k}": v for k, v in env.goal.rows().items()}
    own = {"age": env.age, "action": env.action, **env.controls.rows(), **goal}
    return {**own, **{k: v for event in env.events for k, v in event.rows().items()}}


def _shared(env: ImitationEnv) -> dict[str, Tensor]:
    """What all worlds of an environment share, by name."""
    own = {k: v for event in env.events for k, v in event.state().items()}
    if env.goal.begins:
        own["weights"] = env.weights
    return {**own, "rng": env.goal.rng.get_state()}


E = TypeVar("E", bound=Event)


class ImitationEnv:
    """N characters that follow a goal; the learner's `VecEnv`, and `FeatureSource` with a style.

    An action is `hinges` joint actions followed by the residual's. A step acts toward what the goal asks
    for one control step later, and is rewarded there.

    Args:
        goal: what the characters are to do; a `Reference` is followed clip by clip.
        task: the terms, and what the environment holds beside them (`env.task`).
        substeps: physics steps of a control step.
        weights: `(C,)` odds with which clips are drawn, see `Starts`.
        fused: terms that are often evaluated are recorded and replayed as a whole, see `Terms`; off, one
            by one.

    Attributes:
        goal, task, backend: as given.
        events: help, adaptive sampling, recovery, bodies, ... as far as the task has them.
        help: what is left of the residual force, see `HelpBudget`; an event like the next two.
        recovery, bodies: None for a task without recovery, and for a goal of one body.
        age: `(N,)` control steps since the episode began.
        action: `(N, A)` the last one, as it acted.
        given: `(N, A)` the last one, as it was given; the same without `TaskConfig.filter`.
        controls: turn actions into what drives the characters.
        terms, imitation: values of the last step's rewards by name, and the imitation reward `(N,)`.
    """

    def __init__(
        self,
        goal: Goal | Reference,
        backend: Backend,
        task: TaskConfig,
        substeps: int,
        seed: int = 0,
        weights: Tensor | None = None,
        guard: NanGuard | None = None,
        fused: bool = True,
    ):
        self.num_envs, self.device = backend.num_envs, backend.device
        self.backend, self.task, self.substeps, self._guard = backend, task, substeps, guard
        goal = goal if isinstance(goal, Goal) else goal_of(goal, task, backend, seed, weights)
        self.goal = displaced_goal(goal, task)
        self.hinges = len(self.goal.humanoid.hinges)
        self._limit_n = task.residual.limit_n if task.residual and task.residual.capped else None
        n, here = self.num_envs, self.device
        self.age = torch.zeros(n, dtype=torch.long, device=here)
        self.terms: dict[str, Tensor] = {}
        self.imitation = torch.zeros(n, device=here)
        self.help, self.events = events_of(task, self.goal, backend, seed)
        self.recovery, self.bodies = self.event(RecoveryClock), self.event(BodyAssignment)
        # Recordings are for the CPU, where Python's share of a step is felt.
        fused = fused and here.type == "cpu"
        self.controls = Controls(task, backend, self.goal.humanoid, self.events, fused)
        self.num_actions = self.controls.num_actions
        self.action, self.given = self.controls.action, self.controls.given
        self._every = torch.arange(n, device=here)
        # Whether outcomes are counted by the bins of clips.
        self._counts = task.auto_reset and (task.adaptive > 0 or task.help_by == "bin")
        self._terms = self._make_terms(fused)
        self.goal.aim(None, None)
        # Once as they are, so that it is known which tensors the terms read.
        self._terms.check(self._sources.live(self._told()), n)
        self._sources.settle()
        # Worlds stand on their goals where these are known already.
        if self.goal.begins:
            self._place(None, None)
        self.num_obs = self.observe().shape[1]
        self._style = seen_by(self._terms.style, self.view())
        self._obs = torch.empty(n, self.num_obs, device=here)

    def _make_terms(self, fused: bool) -> Terms:
        task, model, here = self.task, self.backend.model, self.device
        named = {**observables.STANDARD, **task.observables}
        u = torch.zeros(self.num_envs, 6 + self.hinges, dtype=torch.float64, device=here)
        held = {"action": self.action, "age": self.age, **self.controls.sources()}
        # u is 0 in tasks in which nothing gives way.
        held |= {"compliance/u": u, "compliance/level": u[:, 0]}
        for event in self.events:
            for name, value in event.tells().items():
                if isinstance(value, Tensor):
                    held[name] = value
                else:
                    named[name] = value
        self._sources = Sources(self.backend, held)
        roots = torch.as_tensor(model.body_rootid[1:], dtype=torch.long).to(here)
        self._left = None if task.left is None else task.left.to(here)
        context = observables.Context(
            self.goal.layout, self.goal.local, roots, self.hinges, task.residual, self._left
        )
        kinds = placed(task.obs, here), placed(task.rewards, here), placed(task.dones, here)
        return Terms(*kinds, placed(task.style, here), named, context, task.horizon, here, fused)

    # --- what is followed ---------------------------------------------------------------------

    @property
    def reference(self) -> Reference:
        """The clips that the goal is made of; an error where there are none."""
        return self.goal.clips.reference

    @property
    def clip(self) -> Tensor:
        """`(N,)` which clip each world follows."""
        return self.goal.clips.clip

    @property
    def frame(self) -> Tensor:
        """`(N,)` the frame of its clip that each world is at."""
        return self.goal.clips.frame

    @property
    def weights(self) -> Tensor:
        """`(C,)` odds with which new episodes draw their clips, see `Starts.weights`."""
        return self.goal.clips.starts.weights

    @weights.setter
    def weights(self, odds: Tensor) -> None:
        clips = self.goal.clips
        clips.starts.weights = odds
        # Help of what is not drawn does not count.
        self.help.use(clips.drawn(self.task.help_by))

    def set_goal(self, goal: Goal) -> Tensor:
        """Goes on with another goal of the same body, wherever the characters stand; observations."""
        if isinstance(self.goal, DisplacedGoal) and not isinstance(goal, DisplacedGoal):
            self.goal.follow(goal)
            self.goal.offset.zero_()
            self.goal.rate.zero_()
        else:
            self.goal = goal
        if (yielding := self.event(Yielding)) is not None and isinstance(self.goal, DisplacedGoal):
            yielding.goal = self.goal
        self.goal.aim(None, self._held())
        return self.observe()

    def seek(self, clip: Tensor, frame: Tensor) -> Tensor:
        """Goes on at `frame[i]` of `clip[i]`, both `(N,)`, wherever world i stands; observations."""
        self.goal.reset(None, clip, frame)
        self.goal.aim(None, self._held())
        return self.observe()

    def event(self, kind: type[E]) -> E | None:
        """The event of a kind, None without."""
        return next((p for p in self.events if isinstance(p, kind)), None)

    # --- episodes -----------------------------------------------------------------------------

    def reset(self) -> Tensor:
        """New episodes everywhere, drawn by the goal (reference state initialisation)."""
        self._restart(self._every)
        return self.observe()

    def reseed(self, seed: int) -> None:
        """Makes the draws of all later starts repeatable; worlds stay where they are."""
        self.goal.rng.manual_seed(seed)

    def reset_to(self, clip: Tensor, frame: Tensor, kind: Tensor | None = None) -> Tensor:
        """Starts world i exactly on `frame[i]` of `clip[i]`, both `(N,)`; frames past the end of a clip
        that goes on are where its later cycles are. Gives observations.

        kind: `(N,)` kinds of episodes, see `poise.env.recovery`; None begins ordinary ones.
        """
        if kind is not None and self.recovery is None:
            raise PoiseError(
                "this task knows no falls", hint="Set TaskConfig.recovery", code="recovery-off"
            )
        self.goal.reset(None, clip, frame)
        self._place(None, kind)
        return self.observe()

    def _restart(self, ids: Tensor) -> Tensor:
        """New episodes in worlds `ids (n,)`; the worlds that see something else then."""
        self.goal.reset(ids)
        return self._place(ids, None, True)

    def _place(self, ids: Tensor | None, kind: Tensor | None, drawn: bool = False) -> Tensor:
        """Puts the characters of worlds `ids`, all for None, where their goals begin."""
        goal = self.goal
        body = None if self.bodies is None else goal.clips.body(ids)
        episodes = EpisodeStart(ids, goal.start(ids), goal.rng, body, kind, drawn)
        self.age[episodes.rows], self.action[episodes.rows] = 0, 0.0
        for event in self.events:
            event.begin(episodes)
        self.backend.write(ids, *episodes.start)
        self._look(ids)
        goal.aim(ids, self._held())
        seeing = ids if episodes.seeing is None else episodes.seeing
        return self._every if seeing is None else seeing

    def _look(self, ids: Tensor | None) -> None:
        for event in self.events:
            event.look(ids)

    def _held(self) -> Tensor | None:
        """`(N,)` bool, worlds with goals that wait in the next step."""
        return None if self.recovery is None else self.recovery.held()

    # --- stepping -----------------------------------------------------------------------------

    @one_thread()
    def step(self, actions: Tensor) -> EnvStep:
        """One control step for all worlds; `actions (N, A)`."""
        self.drive(actions)
        self.controls.step(self._guard or self.backend, self.substeps)
        return self.renew(self.judge())

    @one_thread()
    def go(self, actions: Tensor) -> Tensor:
        """One control step without rewards, ends and new episodes; gives the observations `(N, O)`. It
        takes a third less time than `step`."""
        self.drive(actions)
        self.controls.step(self._guard or self.backend, self.substeps)
        waited = self._held()
        self.tick()
        self.goal.advance(waited, self._held())
        return self.observe()

    def drive(self, actions: Tensor) -> None:
        """The first part of a step: fills the drive; the physics is then the caller's to step."""
        goal = self.goal
        # Of the step that comes, since `advance` moves them on.
        self._row, self._group = goal.clips.row if self._counts else None, self.help.group(goal)
        if self._sources.reads("linvel_before"):
            torch.sub(self.here().linvel, self.goal_pose().linvel, out=self.controls.linvel_before)
        self.controls.apply(actions, self.age, goal, self.help, self._sources.reads("torque_before"))

    def judge(self) -> EnvStep:
        """The second part of a step: rewards and ends, before any episode begins anew."""
        goal, task = self.goal, self.task
        waited = self._held()
        self.tick()
        ref, ahead = goal.advance(waited, self._held())
        seen = self._sources.of(self._told(None, ref, ahead))
        final, scores, ends, self._style = self._terms.judge(seen)
        # Row 0 is r = sum_k w_k r_k, row 1 the part of it that is imitation, then each r_k.
        reward, self.imitation, *values = scores.unbind(0)
        self.terms = {t.name: v for t, v in zip(task.rewards, values, strict=True)}
        rng = goal.rng if task.auto_reset else None
        late = self.age >= task.horizon
        self._outcome = outcome = StepOutcome(ends, late, ref, goal, self._row, self.age, rng)
        for event in self.events:
            event.judged(outcome)
        failed, terminated, truncated = ends.unbind(0)
        if task.completion_bonus:
            # r (1 + b): with b = g + g^2 + ..., as many of these rewards as one that goes on earns.
            done = terminated & ~failed
            reward = torch.where(done, reward * (1.0 + task.completion_bonus), reward)
        limit = None if self._limit_n is None else self.help.limit(self._limit_n, self._group)
        log = StepLog(self.terms, self.imitation, self.wrench, limit, outcome.log)
        return EnvStep(final, reward, terminated, truncated, final, log, failed)

    def tick(self) -> None:
        """Time goes on by a control step: all of `judge` that is needed where goals move otherwise."""
        self.age += 1
        for event in self.events:
            event.after_step()

    def renew(self, step: EnvStep) -> EnvStep:
        """The last part of a step: new episodes where one ended, and what is seen then."""
        final, obs, outcome = step.final_obs, step.obs, self._outcome
        if self.task.auto_reset:
            for event in self.events:
                event.count(outcome)
            if len(outcome.ids):
                ids = self._restart(outcome.ids)
                # All others see what `judge` has made of them already.
                obs = self._obs.copy_(final)
                obs[ids] = self._observe(ids)
        if self._watched():
            obs = self._observe().clone()
            final = final if self.task.auto_reset else obs
        return step._replace(obs=obs, final_obs=final)

    def unfiltered(self, actions: Tensor) -> Tensor:
        """What to give to the next `step` so that `actions (N, A)` act in spite of the task's filter."""
        return self.controls.unfiltered(actions, self.age)

    @property
    def wrench(self) -> Wrench | None:
        """What the residual force was; None without one."""
        return self.controls.wrench

    def _watched(self) -> bool:
        """Whether the goal has changed by what it sees of the characters."""
        if not self.goal.watches:
            return False
        sim = self.here()
        if changed := self.goal.watch(self.backend.state.qpos, sim.pos, sim.linvel):
            self.goal.aim(None, self._held())
        return changed

    # --- views --------------------------------------------------------------------------------

    def observe(self, ids: Tensor | None = None) -> Tensor:
        """Observations `(n, O)` of worlds `ids (n,)`, all for None, as they stand, after the goal has
        looked at them."""
        self._watched()
        return self._observe(ids).clone()

    @property
    def recorded(self) -> frozenset[str]:
        """Parts that are replayed from a recording: "observe", the observations of worlds that begin
        anew, and "judge", all terms after a step. Terms that look at values, see `record`, never are."""
        return self._terms.recorded

    def record_at_once(self) -> None:
        """Terms are recorded now, for real time: else a later step takes the time of fifty."""
        self._terms.record_at_once()
        told = self._sources.of(self._told())
        # A recording is made at the first call, and made fast at the second.
        for _ in range(2):
            self._terms.observe(told)
            self._terms.judge(told)

    def pose(self) -> Pose:
        """The simulated characters now."""
        lazy = self.here()
        return Pose(*(getattr(lazy, name) for name in FIELDS))

    def here(self) -> Pose:
        """The same, of which only what is asked for is made: before the next step."""
        return self._terms.frame(self._sources).sim

    def goal_pose(self) -> Pose:
        """What the goal asks for now."""
        return observables.headed(self.goal.layout.unpacked(self.goal.now()), self._left)

    def where(self, env: int) -> str:
        """What world `env` is at, for messages."""
        return self.goal.where(env)

    def view(self) -> Frame:
        """The frame that terms see of all worlds, from nothing but where they are."""
        return self._terms.frame(self._sources.live(self._told()))

    def _told(self, ids: Tensor | None = None, *known: Tensor) -> dict[str, Tensor]:
        """What the goal tells worlds `ids (n,)`, see `Sources.of`. known: now and one step later."""
        goal, steps = self.goal, self.task.window
        now, ahead = known or (goal.now(ids), goal.ahead(1, ids))
        return {"goal": now, "ahead": ahead} | ({"window": goal.window(steps, ids)} if steps else {})

    def _observe(self, ids: Tensor | None = None) -> Tensor:
        return self._terms.observe(self._sources.of(self._told(ids), ids))

    @cached_property
    def columns(self) -> dict[str, slice]:
        """The columns of the observations by name, in order: those of each term, such as
        "rotation_goal", and of its parts, such as "rotation_goal.linvel", see `ObsTerm.parts`."""
        out, frame = dict[str, slice](), self.view()
        first = 0
        for term in self._terms.obs:
            width = seen_by((term,), frame).shape[1]
            out |= term.columns(first, width)
            first += width
        return out

    # --- motion prior -------------------------------------------------------------------------

    @property
    def num_features(self) -> int:
        """F, the width of what a motion prior sees of a frame; 0 without `TaskConfig.style`."""
        return self._style.shape[1]

    def features(self) -> Tensor:
        """`(N, F)` of the states that the last step reached, before any restart."""
        return self._style

    def past(self, rows: Tensor, count: int) -> Tensor | None:
        """`(n, count, F)` of the clips up to the starts of the new episodes in `rows (n,)`; NaN where a
        clip begins later, None if all do."""
        past = self.clip_features.past(self.clip[rows], self.frame[rows], count)
        if past is not None and self.recovery is not None:
            past[self.recovery.past(rows)] = torch.nan
        return past

    def demos(self, frames: int) -> ClipWindows:
        """Draws windows of so many frames of the clips, by the odds with which episodes draw clips."""
        return ClipWindows(self.clip_features, frames, lambda: self.weights)

    @cached_property
    def clip_features(self) -> ClipFeatures:
        """Features of the clips' frames, as a motion prior sees them."""
        return ClipFeatures(self.reference, self._terms.style, left=self._left)

    # --- copies and persistence ---------------------------------------------------------------

    def snapshot(self, rows: Tensor | None = None) -> Snapshot:
        """Everything that worlds `rows (n,)`, all for None, are, see `Snapshot`."""
        return take(self, rows)

    def restore(self, snapshot: Snapshot, rows: Tensor | None = None) -> Tensor:
        """Makes worlds `rows (n,)`, all for None, what a snapshot of n worlds holds; a snapshot of one
        world fills them all. It may be that of another environment of the same body and kind of goal.
        Where it holds all worlds of an environment, what they share is restored, too. Gives the
        observations `(N, O)` of all worlds.

        Raises:
            PoiseError: another number of worlds, or the snapshot of another kind of environment.
        """
        put(self, snapshot, rows)
        self._put(rows)
        return self._observe()

    def state(self) -> dict[str, Tensor]:
        """Everything that a bit-exact continuation needs; what another kind of backend needs, too."""
        return state_of(self)

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Continues from `state()`: exactly, or from the same positions and velocities where the state
        is that of another kind of backend (another number format), such as the GPU's."""
        put_state(self, state)
        self._put(None)

    def _put(self, rows: Tensor | None) -> None:
        self._look(rows)
        self.goal.aim(None, self._held())

    def close(self) -> None:
        """Frees the worlds."""
        self.backend.close()
