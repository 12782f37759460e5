"""Runs a policy from given start frames: one loop, and observers that keep what is needed."""

# pyright: reportUnknownMemberType=false
from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Protocol, cast

import mujoco
import numpy as np
import torch
from torch import Tensor

from poise.env import Acts, ImitationEnv, Reference
from poise.errors import PoiseError
from poise.formats.text import write_whole
from poise.kinematics.forward import shapes_of
from poise.machine import one_thread
from poise.motion.rotations import quat_mul, quat_rotate, rotvec_to_quat
from poise.score.rollouts import RolloutSet
from poise.sim import UnstableError

#: Frames of a part of rollouts: 110 MB of 20 bodies.
PADDED = 100_000
#: Seconds that an episode must last to count: shorter ones succeed by doing nothing.
LEAST_S = 1.0
#: rad, by which joint angles and the root's rotation of perturbed starts are off (one deviation).
OFF_RAD = 1e-3


@dataclass(frozen=True)
class Spread:
    """Normal deviations of a start from the reference.

    Attributes:
        joints_rad: of the hinges and of the root's turn about each axis.
        place_m: of the root on the floor, along X and Y.
        velocity_m_s: of the root's velocity along each axis.
        turning_rad_s: of the root's and the hinges' speeds of turning.
        heading_rad: of the whole character about the vertical through its root.
    """

    joints_rad: float = 0.05
    place_m: float = 0.03
    velocity_m_s: float = 0.1
    turning_rad_s: float = 0.2
    heading_rad: float = 0.0

    def __str__(self) -> str:
        heading = f", {self.heading_rad:g} rad of heading" if self.heading_rad else ""
        return (
            f"starts off by {self.joints_rad:g} rad, {self.place_m:g} m, {self.velocity_m_s:g} m/s, "
            f"{self.turning_rad_s:g} rad/s{heading}"
        )

    def times(self, factor: float) -> Spread:
        """All of them so many times as large."""
        return Spread(*(factor * getattr(self, f.name) for f in fields(self)))

    def move(self, qpos: Tensor, qvel: Tensor, rng: np.random.Generator) -> None:
        """Moves a state `(7 + n,)` and `(6 + n,)` in place, by one draw of each deviation."""
        turn = torch.as_tensor(rng.normal(scale=self.joints_rad, size=len(qvel) - 3)).to(qpos)
        qpos[3:7] = quat_mul(qpos[3:7], rotvec_to_quat(turn[:3]))
        qpos[7:] += turn[3:]
        if self.place_m:
            qpos[:2] += torch.as_tensor(rng.normal(scale=self.place_m, size=2)).to(qpos)
        if self.velocity_m_s:
            qvel[:3] += torch.as_tensor(rng.normal(scale=self.velocity_m_s, size=3)).to(qvel)
        if self.turning_rad_s:
            turning = rng.normal(scale=self.turning_rad_s, size=len(qvel) - 3)
            qvel[3:] += torch.as_tensor(turning).to(qvel)
        if self.heading_rad:
            about = torch.tensor([0.0, 0.0, rng.normal(scale=self.heading_rad)]).to(qpos)
            qpos[3:7] = quat_mul(rotvec_to_quat(about), qpos[3:7])
            # The root's linear velocity is the world's, its angular velocity the root's own.
            qvel[:3] = quat_rotate(rotvec_to_quat(about), qvel[:3])


#: Starts that differ enough for the simulation to go another way, and no more.
HAIR = Spread(OFF_RAD, 0.0, 0.0, 0.0)


class Nothing:
    """A policy that does nothing: action 0, which any other must beat."""

    def __init__(self, num_actions: int):
        self.num_actions = num_actions

    def act(self, obs: Tensor) -> Tensor:
        """Zeros `(N, A)` for observations `(N, O)`."""
        return obs.new_zeros(len(obs), self.num_actions)


class Observer(Protocol):
    """Watches episodes that are simulated side by side."""

    def see(self, env: ImitationEnv, step: int) -> bool | None:
        """The worlds after control step `step`, 0 before the first action; True: it has seen enough."""
        ...


@one_thread()
def simulate(env: ImitationEnv, policy: Acts, obs: Tensor, steps: int, *observers: Observer) -> None:
    """Lets a policy act in all worlds from where they stand, for `steps` control steps or until every
    observer has seen enough.

        obs = env.reset_to(clip, start)
        simulate(env, policy, obs, steps, Recorder(env, clip, start))

    Args:
        env: without automatic reset; it is not closed here.
        policy: acts on raw observations, deterministically.
        obs: `(N, O)` of the worlds as they stand, from `env.reset_to`.
    """
    sizes = getattr(policy, "num_obs", env.num_obs), getattr(policy, "num_actions", env.num_actions)
    if sizes != (env.num_obs, env.num_actions):
        raise PoiseError(
            f"the policy takes {sizes[0]} observations and gives {sizes[1]} actions, and the task has "
            f"{env.num_obs} and {env.num_actions}",
            hint="It was trained for other observations, actions, or another body",
            code="policy-unfit",
        )
    for observer in observers:
        observer.see(env, 0)
    for t in range(1, steps + 1):
        obs = env.step(policy.act(obs)).final_obs
        # Every one of them is asked, whatever the others say.
        if all([observer.see(env, t) for observer in observers]):
            return


@dataclass(frozen=True, eq=False)
class Recording:
    """One episode kept whole, for export: `qpos (T, 7 + n)`; `row` is its row in the rollouts;
    `contacts` are what `ContactForces` saw in each frame, () where it did not look."""

    clip: int
    start: int
    qpos: np.ndarray
    row: int
    contacts: tuple[np.ndarray, ...] = ()


def start_frames(reference: Reference, most_frames: int = 40_000) -> tuple[Tensor, Tensor]:
    """(clip, frame) of every frame from which an episode lasts `LEAST_S` or more.

    Every such frame of every clip, thinned evenly only where simulating all of them to the end would
    take more than `most_frames` control steps; frame 0 of every clip is always among them.
    """
    cost = sum(int(n) * int(n) // 2 for n in reference.length)
    stride = max(1, round(cost / most_frames + 0.5)) if cost > most_frames else 1
    clips: list[Tensor] = []
    frames: list[Tensor] = []
    lengths = cast("list[int]", reference.length.tolist())
    least = round(LEAST_S * reference.rate_hz)
    for c, n in enumerate(lengths):
        picks = torch.arange(0, n - 1, stride)
        steps = frames_from(reference, torch.full_like(picks, c), picks) - 1
        picks = picks[(steps >= least) | (picks == 0)]
        clips.append(torch.full_like(picks, c))
        frames.append(picks)
    return torch.cat(clips), torch.cat(frames)


def frames_from(reference: Reference, clip: Tensor, start: Tensor, cycles: int = 2) -> Tensor:
    """`(E,)` frames of each episode to the end of its clip, the start included; cyclic clips are done
    `cycles` times."""
    rounds = torch.where(reference.cyclic.cpu()[clip], cycles, 1)
    return (reference.length.cpu()[clip] - 1) * rounds - start + 1


def perturb(
    env: ImitationEnv, clip: Tensor, start: Tensor, trial: Tensor, spread: Spread = HAIR
) -> Tensor:
    """Moves characters that stand on their starts off them.

    Args:
        clip, start, trial: `(N,)` long; what a world draws depends on its own three numbers alone.
        spread: by how much.

    Returns:
        observations `(N, O)`.
    """
    state = env.backend.state
    qpos, qvel = state.qpos.clone(), state.qvel.clone()
    numbers = cast("list[list[int]]", torch.stack((clip, start, trial), 1).tolist())
    for i, own in enumerate(numbers):
        spread.move(qpos[i], qvel[i], np.random.default_rng(own))
    env.backend.write(None, qpos, qvel)
    return env.observe()


def run_episodes(
    make_env: Callable[[int], ImitationEnv],
    policy: Acts,
    clip: Tensor,
    start: Tensor,
    limit: float = 0.0,
    cycles: int = 2,
    observers: Sequence[Observer] = (),
    trial: Tensor | None = None,
    spread: Spread = HAIR,
) -> tuple[RolloutSet, list[Recording]]:
    """Every episode simulated to the end of its clip (cyclic clips: `cycles` rounds), failed or not.

    Where the simulation of a single episode goes bad, because the motion throws the body about, the
    episode ends and has failed.

    Args:
        make_env: gives an environment of N worlds without automatic reset, which is closed in the end.
        policy: acts on raw observations, deterministically.
        clip, start: `(E,)` clip index and first frame. limit: the help budget, N and N m.
        observers: watch beside the recorder.
        trial: `(E,)` which of several perturbed starts each is, see `perturb`; None leaves characters
            exactly on their starts.
        spread: of perturbed starts.

    Returns:
        the padded rollouts (frame 0 is the start itself, before any action) and, for each clip's
        earliest start, the generalized coordinates.
    """
    if clip.shape != start.shape or clip.ndim != 1 or not len(clip):
        shapes = f"{tuple(clip.shape)} and {tuple(start.shape)}"
        raise PoiseError(
            f"an evaluation needs clip and start of one length, got {shapes}", code="count-differs"
        )
    env = make_env(len(clip))
    try:
        obs = env.reset_to(clip, start)
        if trial is not None:
            obs = perturb(env, clip, start, trial, spread)
        recorder = Recorder(env, clip, start, cycles, trial)
        try:
            simulate(env, policy, obs, recorder.total - 1, recorder, *observers)
        except UnstableError:
            if len(clip) > 1:
                raise
    finally:
        env.close()
    return recorder.rollouts(limit), recorder.recordings()


def run_in_batches(
    make_env: Callable[[int], ImitationEnv],
    policy: Acts,
    reference: Reference,
    clip: Tensor,
    start: Tensor,
    limit: float = 0.0,
    most: int = PADDED,
    trial: Tensor | None = None,
) -> Iterator[RolloutSet]:
    """The rollouts of `run_episodes` in parts, each of episodes of like length.

    So a library is scored (`score_rollouts` takes the parts) without all its frames in memory. Whatever
    fits into one part comes in the given order.

    Args:
        reference: the clips, as the environments have them.
        most: frames of a part, with the padding.
        trial: see `run_episodes`.
    """
    length = frames_from(reference, clip, start)
    order = torch.arange(len(clip))
    if len(clip) * int(length.max()) > most:
        order = length.argsort(stable=True)
    while len(order):
        # Episodes are sorted, so that a part is as long as its last one.
        fits = (torch.arange(1, len(order) + 1) * length[order].cummax(0).values <= most).sum()
        rows, order = order[: max(1, int(fits))], order[max(1, int(fits)) :]
        own = None if trial is None else trial[rows]
        yield run_episodes(make_env, policy, clip[rows], start[rows], limit, trial=own)[0]


class Recorder:
    """Records E episodes over T frames on the CPU, float32: what the score card needs.

    total: T, the frames of the longest episode. tensors: by the names of `RolloutSet`.
    """

    def __init__(
        self,
        env: ImitationEnv,
        clip: Tensor,
        start: Tensor,
        cycles: int = 2,
        trial: Tensor | None = None,
    ):
        # The score card works on the CPU, wherever the worlds are.
        self.reference = ref = env.reference.to(torch.device("cpu"))
        self.clip, self.start, self.trial = clip, start, trial
        self.lengths = frames_from(ref, clip, start, cycles)
        self.total = int(self.lengths.max())
        bodies = len(ref.humanoid.bodies)
        helped = getattr(env.task.residual, "bodies", (0,))
        sizes = {
            **{k: (bodies, 3) for k in ("pos", "ref_pos")},
            **{k: (bodies, 4) for k in ("quat", "ref_quat")},
            **{k: (len(helped), 3) for k in ("force", "torque", "point", "point_vel", "ang_vel")},
        }
        many = len(clip), self.total
        self.tensors = {k: torch.zeros(*many, *size) for k, size in sizes.items()}
        self.reward = {n: torch.zeros(many) for n in [*(t.name for t in env.task.rewards), "total"]}
        # The earliest episode of each clip is kept whole.
        distinct = cast("Tensor", clip.unique())
        self._first = {int(c): int((clip == c).nonzero()[start[clip == c].argmin()]) for c in distinct}
        self._qpos: list[Tensor] = []

    def see(self, env: ImitationEnv, step: int) -> bool:
        """Keeps the frame `step` of all episodes."""
        t = step
        self._qpos.append(env.backend.state.qpos[list(self._first.values())].clone())
        sim, ref = env.pose(), env.goal_pose()
        out = self.tensors
        out["pos"][:, t], out["quat"][:, t] = sim.pos, sim.quat
        out["ref_pos"][:, t], out["ref_quat"][:, t] = ref.pos, ref.quat
        if t == 0:
            return self.total <= 1
        for name, value in {**env.terms, "total": env.imitation}.items():
            self.reward[name][:, t] = value
            if t == 1:
                # The start itself earns nothing; the first step's reward stands in, so that the
                # mean over frames is the mean over steps.
                self.reward[name][:, 0] = value
        wrench = env.wrench
        if wrench is not None:
            bodies = list(wrench.body)
            out["force"][:, t], out["torque"][:, t] = wrench.force, wrench.torque
            out["point"][:, t] = wrench.point
            # The wrench was applied at the poses before this step: its arm is zero for a root wrench.
            arm = wrench.point.cpu() - out["pos"][:, t - 1, bodies]
            ang, vel = sim.angvel[:, bodies].cpu(), sim.linvel[:, bodies].cpu()
            out["point_vel"][:, t] = vel + torch.cross(ang, arm, dim=-1)
            out["ang_vel"][:, t] = ang
        return t + 1 >= self.total

    def rollouts(self, limit: float = 0.0) -> RolloutSet:
        """All episodes, padded. limit: the help budget that they had, N and N m."""
        ref, humanoid = self.reference, self.reference.humanoid
        kept: dict[str, Any] = self.tensors
        lengths = self.lengths.clamp_max(len(self._qpos))
        return RolloutSet(
            **kept,
            alive=torch.arange(self.total) < lengths[:, None],
            lengths=lengths,
            reached_end=lengths == self.lengths,
            reward=self.reward,
            clip=self.clip,
            start=self.start,
            clip_names=ref.names,
            fps=ref.rate_hz,
            mass=humanoid.mass,
            feet=humanoid.feet,
            head=humanoid.head,
            shapes=shapes_of(humanoid.table),
            limit_n=limit,
            limit_nm=limit,
            ref_min_height=ref.min_height[self.clip],
            trial=self.trial,
        )

    def recordings(self) -> list[Recording]:
        """Of each clip the earliest episode."""
        qpos = torch.stack(self._qpos, 1).double().cpu().numpy()
        return [
            Recording(c, int(self.start[row]), qpos[k, : int(self.lengths[row])], row)
            for k, (c, row) in enumerate(self._first.items())
        ]


#: Forces below this are nothing to see, N.
LEAST_N = 1.0


class ContactForces:
    """An observer that keeps the contact forces on the character of one world, frame by frame.

    They are those of the state as it stands after each control step, of MuJoCo's own solver. Contacts of
    one body with one other are summed, at their mean place by force. What a character's own
    parts do to each other is left out.

    Attributes:
        frames: of each frame `(K, 6)`: points, m, and the forces there on the character, N, world axes.
    """

    def __init__(self, world: int = 0):
        self.world = world
        self.frames: list[np.ndarray] = []
        self._data: mujoco.MjData | None = None

    def see(self, env: ImitationEnv, step: int) -> bool:
        """Keeps the frame `step`; it never needs more of them."""
        model = env.backend.get_model(self.world)
        self._data = data = env.backend.get_data(self.world, self._data)
        mujoco.mj_forward(model, data)
        # The character's tree hangs on its first body; all else is the world.
        own = np.asarray(model.body_rootid) == 1
        sums: dict[tuple[int, int], np.ndarray] = {}
        force = np.zeros(6)
        for k in range(data.ncon):
            contact = data.contact[k]
            a, b = (int(model.geom_bodyid[g]) for g in contact.geom)
            if bool(own[a]) == bool(own[b]):
                continue
            mujoco.mj_contactForce(model, data, k, force)
            # Along the frame's first axis it pushes the second geom away from the first.
            push = contact.frame.reshape(3, 3).T @ force[:3] * (1.0 if own[b] else -1.0)
            size = float(np.linalg.norm(push))
            if size < LEAST_N:
                continue
            row = sums.setdefault((a, b), np.zeros(7))
            row += np.concatenate((contact.pos * size, push, [size]))
        rows = [np.concatenate((r[:3] / r[6], r[3:6])) for r in sums.values()]
        self.frames.append(np.array(rows).reshape(-1, 6))
        return True


#: The version of the file, in its array `poise_transitions`.
VERSION = 1


@dataclass(frozen=True, eq=False, repr=False)
class Transitions:
    """S control steps of E episodes, one after another.

        steps = open_run("out").transitions(most=16)
        steps.save("rollouts.npz")

    Attributes:
        obs: `(S, O)` float32, what the policy saw before the step, not normalised.
        actions: `(S, A)` float32, what it did.
        rewards: `(S,)` float32, the sum that the task weighs.
        terms: `(S, K)` float32, the rewards by term, not weighted.
        terminated: `(S,)` bool, the episode ended with this step; nothing is bootstrapped.
        truncated: `(S,)` bool, it was cut off after this step; bootstrap with `last_obs`.
        failed: `(S,)` bool, it ended with this step because the motion was lost.
        episode: `(S,)` int64, from 0.
        qpos, qvel: `(S, 7 + n)` and `(S, 6 + n)` float32, MuJoCo's, before the step.
        last_obs: `(E, O)` float32, what was seen after the last step of each episode.
        clip, start: `(E,)` int64, the clip and the control frame at which each began.
        obs_names, action_names, term_names, clip_names: of the columns and the clips. A column of the
            observations is called `TERM[k]`.
        rate_hz: control steps per second.
    """

    obs: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terms: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    failed: np.ndarray
    episode: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    last_obs: np.ndarray
    clip: np.ndarray
    start: np.ndarray
    obs_names: tuple[str, ...]
    action_names: tuple[str, ...]
    term_names: tuple[str, ...]
    clip_names: tuple[str, ...]
    rate_hz: float

    def __repr__(self) -> str:
        steps, sizes = (
            len(self.obs),
            f"{self.obs.shape[1]} observations, {self.actions.shape[1]} actions",
        )
        return f"Transitions({len(self.clip)} episodes, {steps} steps, {sizes})"

    def save(self, path: str | Path) -> Path:
        """Writes all of it into an npz without pickles, whole or not at all.

        Raises:
            PoiseError: another suffix, or nothing can be written there.
        """
        path = Path(path)
        if path.suffix != ".npz":
            raise PoiseError(
                "rollouts are written as .npz",
                path,
                "Choose a name that ends in .npz",
                code="wrong-suffix",
            )
        arrays = {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, poise_transitions=np.array(VERSION), **arrays)  # type: ignore[arg-type]
        write_whole(path, buffer.getvalue())
        return path


def record_transitions(
    make_env: Callable[[int], ImitationEnv],
    policy: Acts,
    clip: Tensor,
    start: Tensor,
    noise: float = 0.0,
    seed: int = 0,
    cycles: int = 2,
) -> Transitions:
    """Simulates every episode until it ends or its clip does, and keeps each step.

    Args:
        make_env: gives an environment of N worlds without automatic reset, which is closed in the end.
        policy: acts on raw observations.
        clip, start: `(E,)` clip index and first control frame.
        noise: one deviation of what is added to each action, in the actions' own units. The actions that
            are kept hold it.
        seed: of the noise.
        cycles: rounds of a cyclic clip, after which an episode is cut off.
    """
    if not noise >= 0:
        raise PoiseError(f"noise must be at least 0, got {noise:g}", code="out-of-range")
    env, rng = make_env(len(clip)), torch.Generator().manual_seed(seed)
    columns: dict[str, list[Tensor]] = {}
    try:
        obs = env.reset_to(clip, start).clone()
        most = frames_from(env.reference, clip, start, cycles) - 1
        going = torch.ones(len(clip), dtype=torch.bool)
        last = obs.clone()
        for t in range(int(most.max())):
            action = policy.act(obs)
            if noise:
                action = action + noise * torch.randn(action.shape, generator=rng).to(action)
            state = env.backend.state
            row = {"obs": obs.clone(), "actions": action, "qpos": state.qpos, "qvel": state.qvel}
            row = {k: v.detach().to("cpu", torch.float32, copy=True) for k, v in row.items()}
            step = env.step(action)
            obs = step.final_obs.clone()
            row |= {"rewards": step.reward.cpu().float(), "kept": going.clone()}
            row["terms"] = torch.stack([v.cpu().float() for v in env.terms.values()], -1)
            terminated, truncated = step.terminated.cpu(), step.truncated.cpu()
            row |= {"terminated": terminated.clone(), "failed": step.failed.cpu().clone()}
            row["truncated"] = (truncated | (t + 1 >= most)) & ~terminated
            last[going] = obs[going].to(last)
            going &= ~(terminated | row["truncated"])
            for name, value in row.items():
                columns.setdefault(name, []).append(value)
            if not going.any():
                break
        return _transitions(env, columns, last, clip, start)
    finally:
        env.close()


def _transitions(
    env: ImitationEnv, columns: dict[str, list[Tensor]], last: Tensor, clip: Tensor, start: Tensor
) -> Transitions:
    """Episodes one after another, without what was simulated after their ends."""
    kept = torch.stack(columns.pop("kept"), 1)
    flat = {name: torch.stack(values, 1)[kept].numpy() for name, values in columns.items()}
    episode = torch.arange(len(clip))[:, None].expand_as(kept)[kept]
    hinges = env.goal.humanoid.hinges
    more = tuple(f"residual[{k}]" for k in range(env.num_actions - len(hinges)))
    spans = [(term.name, env.columns[term.name]) for term in env.task.obs]
    names = [f"{name}[{k}]" for name, at in spans for k in range(at.stop - at.start)]
    return Transitions(
        **flat,
        episode=episode.numpy(),
        last_obs=last.detach().cpu().float().numpy(),
        clip=clip.numpy().copy(),
        start=start.numpy().copy(),
        obs_names=tuple(names),
        action_names=(*hinges, *more),
        term_names=tuple(t.name for t in env.task.rewards),
        clip_names=tuple(env.reference.names),
        rate_hz=float(env.reference.rate_hz),
    )
