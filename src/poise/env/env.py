"""The imitation environment: many worlds, one reference, a list of terms."""

from __future__ import annotations

import torch
from torch import Tensor

from poise.control import Wrench
from poise.env.actuation import Actuation
from poise.env.bins import FailureRates
from poise.env.body_assignment import BodyAssignment
from poise.env.frame import Frame, Pose, placed
from poise.env.help import HelpBudget
from poise.env.recovery.clock import RecoveryClock
from poise.env.recovery.config import FALLEN, point_goal, root_distance, toward
from poise.env.reference import FIELDS, Reference
from poise.env.starts import Starts
from poise.env.step_log import StepLog
from poise.env.style import ClipFeatures, ClipWindows
from poise.env.task import EnvStep, TaskConfig
from poise.env.terms.evaluate import Seen, Terms, seen_by, sim_pose
from poise.errors import PoiseError
from poise.sim import Backend, NanGuard


class ImitationEnv:
    """N characters that imitate a reference; the learner's `VecEnv`, and `FeatureSource` with a style.

    An action is `hinges` joint actions followed by the residual's. At step t the character stands at
    reference frame t, acts toward frame t + 1, and is rewarded there.

    weights: `(C,)` odds with which clips are drawn, see `Starts`.
    fused: terms are recorded once and replayed as a whole, see `Terms`; off, one by one.
    """

    def __init__(
        self,
        reference: Reference,
        backend: Backend,
        task: TaskConfig,
        substeps: int,
        seed: int = 0,
        weights: Tensor | None = None,
        guard: NanGuard | None = None,
        fused: bool = True,
    ):
        self.num_envs, self.device = backend.num_envs, backend.device
        bins = reference.bins
        practised = bins, task.hard, task.adaptive_over
        self._starts = Starts(reference.length, weights, seed, task.first, *practised)
        self.reference = reference = reference.to(self.device)
        self.failure_rates = (
            FailureRates(len(bins), self.device) if task.hard and task.auto_reset else None
        )
        self.backend, self.task, self.substeps = backend, task, substeps
        self.hinges = len(reference.humanoid.hinges)
        if backend.model.nu != self.hinges:
            raise PoiseError(
                f"the model has {backend.model.nu} actuators, the body {self.hinges} hinges"
            )
        self._extra = task.residual.dims if task.residual else 0
        self._limit_n = task.residual.limit_n if task.residual else 0.0
        self.num_actions = self.hinges + self._extra
        self._guard = guard
        n, here = self.num_envs, self.device
        self.clip = torch.zeros(n, dtype=torch.long, device=here)
        # Views of one tensor, since every step adds one to both.
        self._counts = torch.zeros(2, n, dtype=torch.long, device=here)
        self.frame, self.age = self._counts.unbind(0)
        self.action = torch.zeros(n, self.num_actions, device=here)
        self.wrench: Wrench | None = None
        schedule = task.help if task.auto_reset and task.residual else None
        groups = {"all": 1, "clip": len(reference.length), "bin": len(bins)}[task.help_by]
        self.help = HelpBudget(schedule, here, groups)
        self._use_help()
        self.terms: dict[str, Tensor] = {}
        self.imitation = torch.zeros(n, device=here)
        # What the reference does one step from now, packed; kept up to date by whatever moves a world.
        self._goal, self._goal_rows = torch.empty(0), torch.empty(0, dtype=torch.long)
        self._roots = torch.as_tensor(backend.model.body_rootid[1:], dtype=torch.long).to(here)
        # Recordings are for the CPU, where Python's share of a step is felt.
        fused = fused and here.type == "cpu"
        self._acting = Actuation(backend, task.pd, task.residual, fused)
        asking = (*task.obs, *task.rewards, *task.dones)
        self._torqued = any(getattr(term.fn, "uses_torque", False) for term in asking)
        self._torques = self._bind_torques()
        self.recoveries: RecoveryClock | None = None
        if task.recovery is not None:
            self.recoveries = RecoveryClock(task.recovery, backend, reference.humanoid, task.pd, seed)
        self._bodies: BodyAssignment | None = None
        if len(reference.bodies) > 1:
            if self.recoveries is not None:
                # Falls are those of the first body, which all worlds still have.
                _ = self.recoveries.falls
            self._bodies = BodyAssignment(backend, reference.bodies, reference.body)
        self._no_table, self._every = torch.zeros(n, 0, device=here), torch.arange(n, device=here)
        terms = placed(task.obs, here), placed(task.rewards, here), placed(task.dones, here)
        self._terms = Terms(*terms, placed(task.style, here), self._frame_of, self._ends, here, fused)
        self.reset_to(self.clip, self.frame)
        self.num_obs = self._observe().shape[1]
        self._style = seen_by(self._terms.style, self._frame())
        self._clip_features = ClipFeatures(reference, self._terms.style)
        self._obs = torch.empty(n, self.num_obs, device=here)

    # --- episodes -----------------------------------------------------------------------------

    def reset(self) -> Tensor:
        """New episodes everywhere at random frames (reference state initialisation)."""
        self._restart(torch.arange(self.num_envs, device=self.device))
        return self._observe()

    def reseed(self, seed: int) -> None:
        """Makes the draws of all later starts repeatable; worlds stay where they are."""
        self._starts.rng.manual_seed(seed)

    @property
    def weights(self) -> Tensor:
        """`(C,)` odds with which new episodes draw their clips, see `Starts.weights`."""
        return self._starts.weights

    @weights.setter
    def weights(self, odds: Tensor) -> None:
        self._starts.weights = odds
        self._use_help()

    def _use_help(self) -> None:
        """Help of what is not drawn does not count."""
        used = self._starts.weights > 0
        self.help.use(used[self.reference.bins.clip.cpu()] if self._by_moment else used)

    @property
    def _by_moment(self) -> bool:
        return self.task.help_by == "bin"

    def reset_to(self, clip: Tensor, frame: Tensor, kind: Tensor | None = None) -> Tensor:
        """Starts world i exactly on `frame[i]` of `clip[i]`, both `(N,)`; returns observations.

        Frames past the end of a cyclic clip are where its later cycles are.

        kind: `(N,)` kinds of `poise.env.recovery.config`, in a task with it; None begins tracked
        episodes.
        """
        self.clip.copy_(clip)
        self.frame.copy_(frame)
        self.age.zero_()
        self.action.zero_()
        self._assign_bodies(None, self.clip)
        start = self.reference.coordinates(self.clip, self.frame)
        if self.recoveries is not None:
            kinds = torch.zeros(self.num_envs, dtype=torch.long) if kind is None else kind
            start = self.recoveries.begin(slice(None), kinds, *start, self._starts.rng)
        elif kind is not None:
            raise PoiseError("this task knows no falls", hint="Set TaskConfig.recovery")
        self.backend.write(None, *start)
        self._aim()
        return self._observe() if hasattr(self, "num_obs") else torch.empty(0)

    def set_goal(self, reference: Reference, clip: Tensor, frame: Tensor) -> Tensor:
        """Goes on with other motions of the same body, world i at `frame[i]` of `clip[i]`, both `(N,)`,
        wherever it stands; returns observations. For environments without automatic restarts."""
        self.reference = reference.to(self.device)
        self.clip.copy_(clip)
        self.frame.copy_(frame)
        self._aim()
        return self._observe()

    def _restart(self, ids: Tensor) -> None:
        odds = None if self.failure_rates is None else self.failure_rates.odds
        pick, frame = (x.to(self.device) for x in self._starts.draw(len(ids), odds))
        self.clip[ids], self.frame[ids] = pick, frame
        self.age[ids] = 0
        self.action[ids] = 0.0
        self._assign_bodies(ids, pick)
        start, ahead = self.reference.coordinates(pick, frame), frame + 1
        if self.recoveries is not None:
            rng = self._starts.rng
            start = self.recoveries.begin(ids, self.recoveries.draw(len(ids), rng), *start, rng)
            ahead = self._ahead()[ids]
        self.backend.write(ids, *start)
        self._goal_rows[ids] = self.reference.rows(pick, ahead)
        self._goal[ids] = self.reference.gather_packed(pick, ahead)

    def _assign_bodies(self, rows: Tensor | None, clip: Tensor) -> None:
        """Worlds `rows` take the bodies of `clip`, before their states are written."""
        if self._bodies is not None:
            self._bodies.take(rows, clip)

    def _aim(self) -> None:
        """Looks up where the reference goes from here."""
        ahead = self._ahead()
        self._goal_rows = self.reference.rows(self.clip, ahead)
        self._goal = self.reference.gather_packed(self.clip, ahead, self._goal_rows)

    def _ahead(self) -> Tensor:
        """`(N,)` frames that the references will be at after the next step."""
        held = None if self.recoveries is None else self.recoveries.held
        return self.frame + 1 if held is None else self.frame + 1 - held.long()

    # --- stepping -----------------------------------------------------------------------------

    def step(self, actions: Tensor) -> EnvStep:
        """One control step for all worlds; `actions (N, A)`."""
        if actions.shape != (self.num_envs, self.num_actions):
            raise PoiseError(
                f"actions must be ({self.num_envs}, {self.num_actions}), got {tuple(actions.shape)}"
            )
        # A copy, since a restart clears its rows and the caller's actions are the caller's.
        self.action.copy_(actions)
        row, bins = self._goal_rows, self.reference.bins
        group = bins.of[row] if self._by_moment else self.clip
        help_left = self.help.at(group)
        targets, rows = self.reference.hinges, row
        if self.recoveries is not None and self.task.pd.mode == "additive":
            targets, rows = self.recoveries.targets(targets[row]), self._every
        self.wrench = self._acting.apply(self.action, targets, rows, help_left, self.help.now > 0)
        (self._guard or self.backend).step(self.substeps)
        self._counts += 1
        ref, held = self._goal, None if self.recoveries is None else self.recoveries.tick(self.frame)
        self._goal_rows, self._goal = self.reference.follow(self._goal_rows, self.clip, self.frame, held)
        final, scores, ends, self._style = self._terms.judge(self._seen(ref, self._goal))
        reward, self.imitation, *values = scores.unbind(0)
        self.terms = {t.name: v for t, v in zip(self.task.rewards, values, strict=True)}
        failed, terminated, truncated = ends.unbind(0)
        if self.recoveries is not None:
            apart = root_distance(self.reference.unpacked(ref).pos, self.backend.state.xpos[:, 1:])
            rng = self._starts.rng if self.task.auto_reset else None
            self.recoveries.judge(ends, apart, self.age >= self.task.horizon, rng)
        if self.task.completion_bonus:
            reward = torch.where(
                terminated & ~failed, reward * (1.0 + self.task.completion_bonus), reward
            )
        obs, more = final, self.recoveries and self.recoveries.shares()
        limit = self.help.limit(self._limit_n, group)
        log = StepLog(self.terms, self.imitation, self.wrench, limit, more)
        if self.task.auto_reset:
            ids = (terminated | truncated).nonzero().squeeze(-1)
            self._count(row, ids, failed, terminated)
            if len(ids):
                self._restart(ids)
                ref = self.reference.gather_packed(self.clip[ids], self.frame[ids])
                obs = self._obs.copy_(final)
                obs[ids] = self._terms.observe(self._seen(ref, self._goal[ids], ids))
        return EnvStep(obs, reward, terminated, truncated, final, log, failed)

    def _count(self, row: Tensor, ids: Tensor, failed: Tensor, terminated: Tensor) -> None:
        """Notes what became of the episodes in a step to `row (N,)`, after which those of `ids` end."""
        by_moment = self._by_moment and self.help.schedule is not None
        if by_moment or self.failure_rates is not None:
            seen = self.reference.bins.outcomes(row, self.age, failed, terminated & ~failed)
            if self.recoveries is not None:
                # Who recovers, or has recovered, has not been where its age says.
                seen = seen.of(self.recoveries.kind == 0)
            if self.failure_rates is not None:
                self.failure_rates.add(seen)
            if by_moment:
                self.help.add(*seen)
        if not self._by_moment:
            self.help.count_worlds(self.clip[ids], failed[ids])

    def _ends(self, seen: Seen, failed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Which episodes failed, are terminated and are truncated."""
        # A clip that is done to its end is a finished task, whose remaining return is stated: as many
        # steps like the last as `completion_bonus` says, since with nothing to come the last moments
        # would not matter and characters would fall in them. To bootstrap there would rest on a state
        # whose value is never learned, and the policy comes to exploit it.
        done = self.reference.place(seen.ref).end > 0
        if self.task.recovery is not None:
            free = seen.recovery[:, 1] == 0
            failed, done = failed & free, done & free
        terminated = failed | done
        return failed, terminated, (seen.age >= self.task.horizon) & ~terminated

    # --- views --------------------------------------------------------------------------------

    def pose(self) -> Pose:
        """The simulated characters now."""
        lazy = sim_pose(self._seen(self._goal, self._goal), self.reference.local, self._roots)
        return Pose(*(getattr(lazy, name) for name in FIELDS))

    def where(self, env: int) -> str:
        """Which frame of which clip world `env` is at, for messages."""
        return f"{self.reference.names[int(self.clip[env])]} frame {int(self.frame[env])}"

    def _seen(self, ref: Tensor, ahead: Tensor, ids: Tensor | None = None) -> Seen:
        """What the terms are worked out from, of all worlds or of the worlds `ids`."""
        s = self.backend.state
        fields = s.qpos, s.qvel, s.xpos, s.xquat, s.cvel, s.subtree_com
        table = self._no_table if self.recoveries is None else self.recoveries.table
        seen = Seen(*fields, *self._torques, ref, ahead, self.action, self.age, table)
        if ids is None:
            return seen
        # The reference is that of the worlds `ids` already.
        return Seen(*(x if x is ref or x is ahead else x[ids] for x in seen))

    def _frame_of(self, seen: Seen) -> Frame:
        residual, reference = self.task.residual, self.reference
        place, extra = reference.place(seen.ref), seen.action[:, self.hinges :]
        # The hinges' part of the generalized forces, after the root's six.
        torque = (seen.actuator + seen.damper)[:, 6:].float() if self._torqued else None
        sim, ref = sim_pose(seen, reference.local, self._roots), reference.unpacked(seen.ref)
        ahead, point, recovery = reference.unpacked(seen.ahead), None, self.task.recovery
        if recovery is not None:
            point = point_goal(sim, ref, seen.recovery[:, 2], recovery.switch)
            ahead = toward(sim, ahead, point.far, recovery.reach)
        return Frame(
            sim,
            ref,
            ahead,
            place.phase,
            extra,
            residual.regularizer(extra) if residual else torch.ones_like(place.phase),
            place.low,
            seen.age,
            torque,
            point,
            self._bodies and self._bodies.sizes_of(place.body),
        )

    def _frame(self) -> Frame:
        """What the terms see of all worlds, from nothing but where they are."""
        packed = (self.reference.gather_packed(self.clip, k) for k in (self.frame, self._ahead()))
        return self._frame_of(self._seen(*packed))

    def _observe(self) -> Tensor:
        return seen_by(self._terms.obs, self._frame())

    def _bind_torques(self) -> tuple[Tensor, Tensor]:
        """Views of what servos and damping exert, where a term asks for it; else of nothing."""
        if not self._torqued:
            nothing = torch.zeros(self.num_envs, 0, device=self.device)
            return nothing, nothing
        self.backend.state.bind(("qfrc_actuator", "qfrc_damper"))
        return self.backend.state["qfrc_actuator"], self.backend.state["qfrc_damper"]

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
        past = self._clip_features.past(self.clip[rows], self.frame[rows], count)
        if past is not None and self.recoveries is not None:
            # Whoever lies on the floor has not come there with the clip.
            past[(self.recoveries.kind[rows] & FALLEN).bool()] = torch.nan
        return past

    def demos(self, frames: int) -> ClipWindows:
        """Draws windows of so many frames of the clips, by the odds with which episodes draw clips."""
        return ClipWindows(self._clip_features, frames, lambda: self.weights)

    # --- persistence --------------------------------------------------------------------------

    def state(self) -> dict[str, Tensor]:
        """Everything that a bit-exact continuation needs; what another kind of backend needs, too."""
        return {
            "sim": self.backend.snapshot(),
            "qpos": self.backend.state.qpos.clone(),
            "qvel": self.backend.state.qvel.clone(),
            "clip": self.clip.clone(),
            "frame": self.frame.clone(),
            "age": self.age.clone(),
            "action": self.action.clone(),
            "help": self.help.state(),
            "weights": self.weights,
            "rng": self._starts.rng.get_state(),
            **({} if self.failure_rates is None else {"hardness": self.failure_rates.state()}),
            **({} if self.recoveries is None else self.recoveries.state()),
        }

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Continues from `state()`: exactly, or from the same positions and velocities where the state
        is that of another kind of backend (another number format), such as the GPU's."""
        self._assign_bodies(None, state["clip"].to(self.device))
        if state["sim"].dtype == self.backend.state.qpos.dtype:
            self.backend.restore(state["sim"])
        else:
            self.backend.write(None, state["qpos"], state["qvel"])
        for name in ("clip", "frame", "age", "action"):
            getattr(self, name).copy_(state[name])
        self.help.load_state(state["help"])
        if self.failure_rates is not None and "hardness" in state:
            self.failure_rates.load_state(state["hardness"])
        if self.recoveries is not None:
            self.recoveries.load_state(state)
        self._aim()
        if "weights" in state:  # States of former versions are without; their odds never changed.
            self.weights = state["weights"]
        self._starts.rng.set_state(state["rng"])

    def close(self) -> None:
        """Frees the worlds."""
        self.backend.close()
