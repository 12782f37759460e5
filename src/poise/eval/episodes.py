"""Runs a policy from given start frames and records what the score card needs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from poise.env import Acts, ImitationEnv, Reference
from poise.errors import PoiseError
from poise.eval.rolloutset import RolloutSet
from poise.kin.solids import shapes_of

#: Frames of a part of rollouts: 110 MB of 20 bodies.
PADDED = 100_000


@dataclass(frozen=True, eq=False)
class Recording:
    """One episode kept whole, for export: `qpos (T, 7 + n)`; `row` is its row in the rollouts."""

    clip: int
    start: int
    qpos: np.ndarray
    row: int


def start_frames(reference: Reference, most_frames: int = 40_000) -> tuple[Tensor, Tensor]:
    """(clip, frame) of every frame from which at least one step can be made.

    Every start frame of every clip, thinned evenly only where simulating all of them to the end
    would take more than `most_frames` control steps; frame 0 of every clip is always among them.
    """
    cost = sum(int(n) * int(n) // 2 for n in reference.length)
    stride = max(1, round(cost / most_frames + 0.5)) if cost > most_frames else 1
    clips, frames = [], []
    for c, n in enumerate(reference.length.tolist()):
        picks = torch.arange(0, n - 1, stride)
        clips.append(torch.full_like(picks, c))
        frames.append(picks)
    return torch.cat(clips), torch.cat(frames)


def run_episodes(
    make_env: Callable[[int], ImitationEnv],
    policy: Acts,
    clip: Tensor,
    start: Tensor,
    limit_n: float = 0.0,
    limit_nm: float = 0.0,
    cycles: int = 2,
) -> tuple[RolloutSet, list[Recording]]:
    """Every episode simulated to the end of its clip (cyclic clips: `cycles` rounds), failed or not.

    Args:
        make_env: gives an environment of N worlds without automatic reset.
        policy: acts on raw observations, deterministically.
        clip, start: `(E,)` clip index and first frame. limit_n, limit_nm: the help budget.

    Returns:
        the padded rollouts (frame 0 is the start itself, before any action) and, for each clip's
        earliest start, the generalized coordinates.
    """
    if clip.shape != start.shape or clip.ndim != 1 or not len(clip):
        raise PoiseError(
            f"an evaluation needs clip and start of one length, got {tuple(clip.shape)} and "
            f"{tuple(start.shape)}"
        )
    env = make_env(len(clip))
    # The score card works on the CPU, wherever the worlds are.
    ref = env.reference.to(torch.device("cpu"))
    rounds = torch.where(ref.cyclic[clip], cycles, 1)
    lengths = (ref.length[clip] - 1) * rounds - start + 1
    total = int(lengths.max())
    obs = env.reset_to(clip, start)
    first = {int(c): int((clip == c).nonzero()[start[clip == c].argmin()]) for c in clip.unique()}
    kept: list[Tensor] = []
    store = _Store(env, len(clip), total)
    store.add(0, env)
    kept.append(env.backend.state.qpos[list(first.values())].clone())
    for t in range(1, total):
        step = env.step(policy.act(obs))
        obs = step.final_obs
        store.add(t, env)
        kept.append(env.backend.state.qpos[list(first.values())].clone())
    qpos = torch.stack(kept, 1).double().cpu().numpy()
    recordings = [
        Recording(c, int(start[row]), qpos[k, : int(lengths[row])], row)
        for k, (c, row) in enumerate(first.items())
    ]
    alive = torch.arange(total) < lengths[:, None]
    humanoid = ref.humanoid
    rollouts = RolloutSet(
        pos=store.tensors["pos"],
        quat=store.tensors["quat"],
        ref_pos=store.tensors["ref_pos"],
        ref_quat=store.tensors["ref_quat"],
        force=store.tensors["force"],
        torque=store.tensors["torque"],
        point_vel=store.tensors["point_vel"],
        ang_vel=store.tensors["ang_vel"],
        alive=alive,
        lengths=lengths,
        reached_end=torch.ones(len(clip), dtype=torch.bool),
        reward=store.reward,
        clip=clip,
        start=start,
        clip_names=ref.names,
        fps=ref.rate_hz,
        mass=humanoid.mass,
        feet=humanoid.feet,
        shapes=shapes_of(humanoid.table, torch.float32),
        limit_n=limit_n,
        limit_nm=limit_nm,
        ref_min_height=ref.min_height[clip],
    )
    env.close()
    return rollouts, recordings


def run_in_batches(
    make_env: Callable[[int], ImitationEnv],
    policy: Acts,
    reference: Reference,
    clip: Tensor,
    start: Tensor,
    limit_n: float = 0.0,
    limit_nm: float = 0.0,
    cycles: int = 2,
    most: int = PADDED,
) -> Iterator[RolloutSet]:
    """The rollouts of `run_episodes` in parts, each of episodes of like length.

    So a library is scored (`score_rollouts` takes the parts) without all its frames in memory. Whatever
    fits into one part comes in the given order.

    Args:
        reference: the clips, as the environments have them.
        most: frames of a part, with the padding.
    """
    rounds = torch.where(reference.cyclic.cpu()[clip], cycles, 1)
    length = (reference.length.cpu()[clip] - 1) * rounds - start + 1
    order = torch.arange(len(clip))
    if len(clip) * int(length.max()) > most:
        order = length.argsort(stable=True)
    while len(order):
        # Episodes are sorted, so that a part is as long as its last one.
        fits = (torch.arange(1, len(order) + 1) * length[order].cummax(0).values <= most).sum()
        rows, order = order[: max(1, int(fits))], order[max(1, int(fits)) :]
        yield run_episodes(make_env, policy, clip[rows], start[rows], limit_n, limit_nm, cycles)[0]


class _Store:
    """Preallocated float32 recordings of E episodes over T frames."""

    def __init__(self, env: ImitationEnv, episodes: int, total: int):
        bodies = len(env.reference.humanoid.bodies)
        helped = getattr(env.task.residual, "bodies", (0,))
        sizes = {
            **{k: (bodies, 3) for k in ("pos", "ref_pos")},
            **{k: (bodies, 4) for k in ("quat", "ref_quat")},
            **{k: (len(helped), 3) for k in ("force", "torque", "point_vel", "ang_vel")},
        }
        self.tensors = {k: torch.zeros(episodes, total, *size) for k, size in sizes.items()}
        names = [t.name for t in env.task.rewards] + ["total"]
        self.reward = {name: torch.zeros(episodes, total) for name in names}

    def add(self, t: int, env: ImitationEnv) -> None:
        sim, ref = env.pose(), env.reference.gather(env.clip, env.frame)
        out = self.tensors
        out["pos"][:, t], out["quat"][:, t] = sim.pos, sim.quat
        out["ref_pos"][:, t], out["ref_quat"][:, t] = ref.pos, ref.quat
        if t == 0:
            return
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
            # The wrench was applied at the poses before this step: its arm is zero for a root wrench.
            arm = wrench.point.cpu() - out["pos"][:, t - 1, bodies]
            ang, vel = sim.angvel[:, bodies].cpu(), sim.linvel[:, bodies].cpu()
            out["point_vel"][:, t] = vel + torch.linalg.cross(ang, arm)
            out["ang_vel"][:, t] = ang
