"""The environment on mujoco-warp and on CUDA tensors: what it does there is what it does on the CPU."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from poise.env import ImitationEnv, Reference
from poise.learn import PPOConfig
from poise.learn.trainer import Trainer
from poise.score import run_episodes
from poise.sim import Drive, NanGuard, WarpBackend
from toy_human import swing
from warp_device import WARP_DEVICE, needs_warp

N = 3
#: A device that every build of torch knows; CUDA tensors, even fake ones, need a build for CUDA.
ELSEWHERE = torch.device("meta")


def on_warp(task, auto_reset: bool = True) -> ImitationEnv:
    """The same environment as `task.env`, its physics by mujoco-warp."""
    backend = WarpBackend(task.model, N, WARP_DEVICE)
    settings = replace(task.task, auto_reset=auto_reset)
    return ImitationEnv(
        task.reference, backend, settings, task.config.sim.substeps, guard=NanGuard(backend)
    )


@needs_warp
@pytest.mark.parametrize("phc", [False, True], ids=["rfc", "phc"])
def test_steps_are_those_of_the_cpu(make_task, make_phc, phc):
    """Observations, rewards and ends of a few control steps, with residual forces and restarts."""
    task = (make_phc if phc else make_task)(swing(0.4))
    warp, cpu = on_warp(task), task.env(N, threads=1)
    assert warp.device == torch.device(WARP_DEVICE) and cpu.device == torch.device("cpu")
    close(warp.reset(), cpu.reset())
    assert torch.equal(warp.frame.cpu(), cpu.frame)
    rng = torch.Generator().manual_seed(1)
    restarted = False
    for _ in range(6):
        action = 0.1 * torch.randn(N, cpu.num_actions, generator=rng)
        ours, theirs = warp.step(action.to(warp.device)), cpu.step(action)
        close(ours.obs, theirs.obs)
        close(ours.final_obs, theirs.final_obs)
        close(ours.reward, theirs.reward)
        assert torch.equal(ours.terminated.cpu(), theirs.terminated)
        assert torch.equal(ours.truncated.cpu(), theirs.truncated)
        restarted |= bool((ours.terminated | ours.truncated).any())
        for name in ("reward/energy",) if phc else ("help/force_n",):
            assert ours.log[name] == pytest.approx(theirs.log[name], rel=1e-3)
        close(warp.features(), cpu.features())
    assert restarted and torch.equal(warp.frame.cpu(), cpu.frame)
    goes_on_elsewhere(warp, cpu)
    trains(warp)
    evaluates(task)


@needs_warp
def test_cycles_are_carried_where_the_worlds_are(make_task):
    """What a clip that goes round has travelled by its second cycle, on the device of the worlds."""
    own = make_task(swing(0.4)).reference
    motion = own.qpos.numpy().copy()
    motion[-1] = motion[0]
    motion[-1, 0] += 0.5
    cyclic = Reference(own.humanoid, [motion], own.rate_hz, ["round"], [True])
    there = cyclic.to(torch.device(WARP_DEVICE))
    clip, frame = torch.zeros(2, dtype=torch.long), torch.tensor([0, len(motion) + 1])
    turn, move = there.carry(clip.to(there.qpos.device), frame.to(there.qpos.device))
    assert turn.device == move.device == there.qpos.device
    assert move[:, 0].tolist() == pytest.approx([0.0, 0.5])


def close(got: Tensor, want: Tensor) -> None:
    """Within what float32 physics with contacts leaves in a few steps."""
    torch.testing.assert_close(got.cpu(), want, rtol=5e-3, atol=5e-3)


def goes_on_elsewhere(warp: ImitationEnv, cpu: ImitationEnv) -> None:
    """A state saved on one device continues on the other: the same place, not the same bits."""
    kept = {name: value.cpu() for name, value in warp.state().items()}
    cpu.load_state(kept)
    close(warp.backend.state.qpos.cpu().double(), cpu.backend.state.qpos)
    assert torch.equal(warp.frame.cpu(), cpu.frame)
    warp.load_state(cpu.state())
    warp.load_state(kept)
    action = torch.zeros(N, cpu.num_actions)
    close(warp.step(action.to(warp.device)).final_obs, cpu.step(action).final_obs)


def trains(env: ImitationEnv) -> None:
    """One iteration of the learner where the worlds are."""
    trainer = Trainer(env, PPOConfig(horizon=2, epochs=1, minibatch=N), 0, "toy")
    stats = trainer.iterate()
    assert stats.batch == 2 * N and next(trainer.ppo.critic.parameters()).device == env.device
    trainer.load_state(trainer.state())


def evaluates(task) -> None:
    """An evaluation's rollouts lie on the CPU."""
    policy = SimpleNamespace(act=lambda obs: torch.zeros(N, env.num_actions, device=obs.device))
    env = on_warp(task, auto_reset=False)
    clip, start = torch.zeros(N, dtype=torch.long), torch.tensor([8, 9, 10])
    rollouts, recordings = run_episodes(lambda n: env, policy, clip, start)
    assert rollouts.pos.device.type == rollouts.reward["total"].device.type == "cpu"
    assert recordings[0].qpos.dtype == np.float64


class FakeState(SimpleNamespace):
    """Fields under MuJoCo's names, further ones of which are asked for."""

    def bind(self, names: tuple[str, ...]) -> None:
        for name in names:
            setattr(self, name, torch.zeros_like(self.qvel))

    def __contains__(self, name: str) -> bool:
        return hasattr(self, name)

    def __getitem__(self, name: str) -> Tensor:
        return getattr(self, name)


class FakeBackend:
    """Worlds that stand still, on a device that is not the CPU."""

    def __init__(self, model: mujoco.MjModel):
        def zeros(*shape: int) -> Tensor:
            return torch.zeros(N, *shape, device=ELSEWHERE)

        b = model.nbody
        self.model, self.num_envs, self.device = model, N, ELSEWHERE
        self.state = FakeState(
            qpos=zeros(model.nq), qvel=zeros(model.nv), xpos=zeros(b, 3), xquat=zeros(b, 4),
            xipos=zeros(b, 3), subtree_com=zeros(b, 3), cvel=zeros(b, 6),
        )  # fmt: skip
        self.drive = Drive.zeros(N, model.nu, model.nv, b, torch.float32, self.device)

    def write(self, rows: Tensor | None, qpos: Tensor, qvel: Tensor) -> None:
        self.state.qpos[:] = qpos.to(self.state.qpos)
        self.state.qvel[:] = qvel.to(self.state.qvel)

    def step(self, nstep: int = 1) -> None:
        pass


@pytest.mark.parametrize(
    "settings",
    [{}, {"method": "rfc-explicit"}, {"method": "deepmimic"}, {"reward": "local"}],
    ids=["rfc-implicit", "rfc-explicit", "deepmimic", "local"],
)
def test_no_step_mixes_devices(make_task, settings):
    """Torch's fake tensors have a device and refuse to meet those of another, without any GPU."""
    task = make_task(swing(), **settings)
    quiet = replace(task.task, auto_reset=False)
    with FakeTensorMode(allow_non_fake_inputs=True):
        env = ImitationEnv(task.reference, FakeBackend(task.model), quiet, 2)
        out = env.step(torch.zeros(N, env.num_actions, device=ELSEWHERE))
        for value in (out.obs, out.reward, out.terminated, out.truncated, env.pose().linvel):
            assert value.device == env.device
        env.pose()
        some = env.observe(torch.arange(2, device=ELSEWHERE))
        assert some.device == env.device and some.shape == (2, env.num_obs)
        env.reset()


def test_phcs_terms_mix_no_devices_either(make_phc):
    task = make_phc(swing())
    quiet = replace(task.task, auto_reset=False)
    with FakeTensorMode(allow_non_fake_inputs=True):
        env = ImitationEnv(task.reference, FakeBackend(task.model), quiet, 2)
        out = env.step(torch.zeros(N, env.num_actions, device=ELSEWHERE))
        rows = torch.arange(5, device=ELSEWHERE)
        seen = env.clip_features(rows)
        for value in (out.obs, out.reward, out.terminated, env.features(), seen, env.terms["energy"]):
            assert value.device == env.device
        assert seen.shape == (5, env.num_features)
        env.reset()
