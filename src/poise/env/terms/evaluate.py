"""All terms of a task as one function of tensors, recorded once and replayed without Python."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import torch
from torch import Tensor

from poise.env.frame import DoneTerm, Frame, LazyPose, ObsTerm, Pose, RewardTerm
from poise.env.record import TensorFunction, record
from poise.spatial import heading_quat

#: From so many worlds on, two threads evaluate a half each.
MANY = 256


class Seen(NamedTuple):
    """What the terms of N worlds are worked out from: MuJoCo's own arrays (float64) and the rest.

    actuator, damper: what servos and joint damping exert, `(N, 0)` where no term asks for torques.
    ref, ahead: packed reference poses now and one control step later, see `Reference`. action
    `(N, A)`: the last one. age `(N)`: control steps since the episode began. recovery: the table of
    `RecoveryClock`, `(N, 0)` in a task without.
    """

    qpos: Tensor
    qvel: Tensor
    xpos: Tensor
    xquat: Tensor
    cvel: Tensor
    subtree_com: Tensor
    actuator: Tensor
    damper: Tensor
    ref: Tensor
    ahead: Tensor
    action: Tensor
    age: Tensor
    recovery: Tensor


def sim_pose(seen: Seen, local: Callable[[Tensor], Tensor], roots: Tensor) -> Pose:
    """The simulated characters; read it before the next step.

    local: the turns of hinged bodies of `qpos`. roots: each body's root, as a body of the model.
    """

    def linvel() -> Tensor:
        # v(xpos) = v(c) + omega x (xpos - c), see `sim.body_linear_velocity_w`.
        arm = pose.pos - seen.subtree_com.index_select(1, roots).float()
        return seen.cvel[:, 1:, 3:].float() + torch.linalg.cross(pose.angvel, arm)

    pose = LazyPose(
        qpos=lambda: seen.qpos.float(),
        qvel=lambda: seen.qvel.float(),
        pos=lambda: seen.xpos[:, 1:].float(),
        quat=lambda: seen.xquat[:, 1:].float(),
        linvel=linvel,
        angvel=lambda: seen.cvel[:, 1:, :3].float(),
        com=lambda: seen.subtree_com[:, 1].float(),
        local=lambda: local(pose.qpos),
        heading=lambda: heading_quat(pose.qpos[:, 3:7]),
    )
    return pose


def seen_by(terms: tuple[ObsTerm, ...], frame: Frame) -> Tensor:
    """The observations `(N, O)` of some terms side by side; O is 0 without any."""
    parts = [term.fn(frame, **term.params) for term in terms]
    return torch.cat(parts, -1) if parts else frame.phase.unsqueeze(-1)[:, :0]


class Evaluation(NamedTuple):
    """obs `(N, O)`. scores `(2 + K, N)`: the reward, the part of it that is imitation, and the value of
    each of K reward terms. ends `(3, N)` bool: failed, terminated, truncated. style `(N, F)`: what a
    motion prior sees."""

    obs: Tensor
    scores: Tensor
    ends: Tensor
    style: Tensor


class Terms:
    """The terms of a task: evaluated one by one, or replayed from a recording of just that.

    Args:
        frame: what the terms see, made of `Seen`.
        style: what a motion prior sees, none for none.
        ends: which episodes failed, are terminated and truncated, by what was seen and what the terms
            call a failure.
        fused: replay a recording of the first evaluation, see `record`; on the CPU only.
    """

    def __init__(
        self,
        obs: tuple[ObsTerm, ...],
        rewards: tuple[RewardTerm, ...],
        dones: tuple[DoneTerm, ...],
        style: tuple[ObsTerm, ...],
        frame: Callable[[Seen], Frame],
        ends: Callable[[Seen, Tensor], tuple[Tensor, Tensor, Tensor]],
        device: torch.device,
        fused: bool = True,
    ):
        self.obs, self.rewards, self.dones, self.style = obs, rewards, dones, style
        self.frame, self.ends = frame, ends
        self.fused = fused
        # Row 0 weighs the terms for the reward, row 1 for the imitation reward that is reported.
        shares = [[t.weight, t.weight * t.imitation] for t in rewards]
        self._weights = torch.tensor(shares).reshape(-1, 2).T.contiguous().to(device)
        # Which terms count near the reference and which far from it.
        counts = [[t.when != "far", t.when != "near"] for t in rewards]
        self._near, self._far = (
            torch.tensor(counts, dtype=torch.bool).reshape(-1, 2, 1).to(device).unbind(1)
        )
        self._recorded: dict[str, TensorFunction] = {}
        self._pool: ThreadPoolExecutor | None = None

    def observe(self, seen: Seen) -> Tensor:
        """The observations `(N, O)`."""
        return self._run("observe", self._observe, seen)[0]

    def judge(self, seen: Seen) -> Evaluation:
        """Observations, rewards and failures."""
        worlds = len(seen.ref)
        if not self.fused or worlds < MANY:
            return Evaluation(*(x.clone() for x in self._run("judge", self._judge, seen)))
        # A recording runs without Python's lock, so that the second half really runs beside the first.
        # Many worlds are always cut, whatever the machine, since it may move the last digit.
        first, second = (Seen(*half) for half in zip(*(x.tensor_split(2) for x in seen), strict=True))
        if "judge" not in self._recorded:
            self._run("judge", self._judge, first)
        other = self._helper().submit(self._run, "judge", self._judge, second)
        ours, theirs = self._run("judge", self._judge, first), other.result()
        obs, scores, ends, style = zip(ours, theirs, strict=True)
        return Evaluation(torch.cat(obs), torch.cat(scores, 1), torch.cat(ends, 1), torch.cat(style))

    def _helper(self) -> ThreadPoolExecutor:
        if self._pool is None:
            # One thread for torch in it; without this it would start as many as there are cores.
            self._pool = ThreadPoolExecutor(1, "terms", torch.set_num_threads, (1,))
        return self._pool

    def _observe(self, *seen: Tensor) -> tuple[Tensor, ...]:
        return (seen_by(self.obs, self.frame(Seen(*seen))),)

    def _judge(self, *seen: Tensor) -> tuple[Tensor, ...]:
        all_seen = Seen(*seen)
        frame = self.frame(all_seen)
        rewards = [term.fn(frame, **term.params) for term in self.rewards]
        values = torch.stack(rewards or [frame.phase])[: len(rewards)]
        if frame.point is not None:
            values = torch.where(torch.where(frame.point.far, self._far, self._near), values, 0.0)
        failed = torch.zeros_like(frame.phase, dtype=torch.bool)
        for term in self.dones:
            failed = failed | term.fn(frame, **term.params)
        scores = torch.cat((self._weights @ values, values))
        ends = torch.stack(self.ends(all_seen, failed))
        return seen_by(self.obs, frame), scores, ends, seen_by(self.style, frame)

    def _run(self, name: str, plain: TensorFunction, seen: Seen) -> tuple[Tensor, ...]:
        if not self.fused:
            return plain(*seen)
        if name not in self._recorded:
            self._recorded[name] = record(plain, tuple(seen))
        return self._recorded[name](*seen)
