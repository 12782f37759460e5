"""Runs a policy from given start frames: one loop, and observers that keep what an evaluation needs.

obs = env.reset_to(clip, start)
simulate(env, policy, obs, steps, Recorder(env, clip, start), ...)
"""

# pyright: reportUnknownMemberType=false
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np
import torch
from torch import Tensor

from poise.env import Acts, ImitationEnv, Reference
from poise.errors import PoiseError
from poise.eval.rolloutset import RolloutSet
from poise.kin.solids import shapes_of
from poise.machine import one_thread
from poise.sim import UnstableError
from poise.spatial import quat_mul, rotvec_to_quat

#: Frames of a part of rollouts: 110 MB of 20 bodies.
PADDED = 100_000
#: Seconds that an episode must last to count: shorter ones succeed by doing nothing.
LEAST_S = 1.0
#: rad, by which joint angles and the root's rotation of perturbed starts are off (one deviation).
OFF_RAD = 1e-3


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


def perturb(env: ImitationEnv, clip: Tensor, start: Tensor, trial: Tensor) -> Tensor:
    """Turns all joints and the root of characters that stand on their starts by about `OFF_RAD`.

    Args:
        clip, start, trial: `(N,)` long; what a world draws depends on its own three numbers alone.

    Returns:
        observations `(N, O)`.
    """
    state = env.backend.state
    turns = state.qvel.new_zeros(env.num_envs, state.qvel.shape[1] - 3)
    numbers = cast("list[list[int]]", torch.stack((clip, start, trial), 1).tolist())
    for i, own in enumerate(numbers):
        drawn = np.random.default_rng(own).normal(scale=OFF_RAD, size=turns.shape[1])
        turns[i] = torch.as_tensor(drawn)
    qpos = state.qpos.clone()
    qpos[:, 3:7] = quat_mul(qpos[:, 3:7], rotvec_to_quat(turns[:, :3]))
    qpos[:, 7:] += turns[:, 3:]
    env.backend.write(None, qpos, state.qvel.clone())
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

    Returns:
        the padded rollouts (frame 0 is the start itself, before any action) and, for each clip's
        earliest start, the generalized coordinates.
    """
    if clip.shape != start.shape or clip.ndim != 1 or not len(clip):
        shapes = f"{tuple(clip.shape)} and {tuple(start.shape)}"
        raise PoiseError(f"an evaluation needs clip and start of one length, got {shapes}")
    env = make_env(len(clip))
    try:
        obs = env.reset_to(clip, start)
        if trial is not None:
            obs = perturb(env, clip, start, trial)
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
            shapes=shapes_of(humanoid.table, torch.float32),
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
