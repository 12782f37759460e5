"""One scene with everything in it on the Warp backend, beside the same scene on MuJoCo."""

from __future__ import annotations

import mujoco
import pytest
import torch
from torch import Tensor

from poise.body import generate_table, make_humanoid
from poise.sim import Backend, Character, Link, Scene, SceneSim, Touch, WarpBackend, make_backend
from poise.sim import scene_sim as module
from poise.sim.props import Ball, Box, Carrier, Door
from toy_human import human
from warp_device import WARP_DEVICE, needs_warp

N = 3


@pytest.fixture
def scenes(monkeypatch: pytest.MonkeyPatch) -> list[SceneSim]:
    """Two characters, a ball, a door, a box on a moving plate, one that hangs, and a floor."""
    body = make_humanoid(human(), generate_table(human()))
    things = (
        Ball("ball", pos=(0.0, 3.0, 1.0), mass=1.0),
        Door("door", pos=(6.0, 0.0, 0.0)),
        Character(body, "anna"),
        Character(body, "ben"),
        Carrier("plate", pos=(-4.0, 0.0, 0.05)),
        Box("box", (0.2, 0.2, 0.2), (-4.0, 0.0, 0.2), mass=3.0),
        Box("top", (0.2, 0.2, 0.2), (0.0, 6.0, 2.0)),
        Box("lamp", (0.2, 0.2, 0.2), (0.0, 6.0, 1.79), mass=4.0),
    )
    scene = Scene(things, (Link("hook", "top", "lamp"),), (Touch("hit", "ball", "ben"),))

    def on_warp(model: mujoco.MjModel, n: int, device: str, threads: int = 0) -> Backend:
        return WarpBackend(model, n, WARP_DEVICE)

    made = [SceneSim(scene, N, threads=1)]
    monkeypatch.setattr(module, "make_backend", on_warp)
    made.append(SceneSim(scene, N, WARP_DEVICE))
    monkeypatch.setattr(module, "make_backend", make_backend)
    return made


def play(sim: SceneSim) -> dict[str, Tensor]:
    """The same on either backend: a throw, a push, a weld in two worlds, a reset of one character."""
    rows, model = sim.characters(), sim.scene.model
    here = rows.device
    start = torch.tensor(rows.model.qpos0, device=here).repeat(2 * N, 1)
    start[:, 2] += 1.2
    start[1::2, 1] += 1.5
    rest = torch.zeros(2 * N, rows.model.nv, device=here)
    rows.write(None, start, rest)
    sim.switch("hook", True, torch.tensor([0, 2], device=here))
    ball = torch.tensor([[0.0, 2.2, 1.2, 1.0, 0, 0, 0]], device=here).repeat(N, 1)
    flight = torch.tensor([[0.0, -4.0, 1.0, 0, 0, 0]], device=here).repeat(N, 1)
    sim.place("ball", ball, flight)
    sim.backend.drive.qfrc_applied[:, sim.scene.place("door").dofs] = 5.0
    hit = torch.zeros(N, 3, device=here)
    for k in range(20):
        speed = torch.tensor([[0.5, 0.0, 0.0, 0.0]], device=here).repeat(N, 1)
        sim.place("plate", speed * k / 60, speed)
        rows.drive.ctrl.copy_(start[:, 7:])
        if k < 5:
            rows.drive.xfrc_applied[0, 1, 0] = 100.0
        else:
            rows.drive.xfrc_applied.zero_()
        if k == 10:
            rows.write(torch.tensor([3], device=here), start[3:4], rest[3:4])
        rows.step(1)
        hit += sim.touch("hit").force.to(hit) * model.opt.timestep
    place, state = sim.scene.place, sim.backend.state
    return {
        "characters": rows.state.qpos.double().cpu().clone(),
        "door": state.qpos[:, place("door").qpos].double().cpu().clone(),
        "box": state.xpos[:, place("box").body].double().cpu().clone(),
        "lamp": state.xpos[:, place("lamp").body].double().cpu().clone(),
        "ball": state.qvel[:, place("ball").dofs][:, :3].double().cpu().clone(),
        "hit": hit.double().cpu(),
    }


@needs_warp
def test_everything_in_one_scene(scenes: list[SceneSim]) -> None:
    cpu, warp = (play(sim) for sim in scenes)
    # What was done shows, in the worlds in which it was done.
    for seen in (cpu, warp):
        assert bool((seen["door"] > 0.02).all())
        assert float(seen["box"][0, 0]) > -3.95
        assert seen["lamp"][[0, 2], 2].tolist() == pytest.approx([1.79] * 2, abs=0.02)
        assert float(seen["lamp"][1, 2]) < 1.4
        assert float(seen["characters"][0, 0]) > float(seen["characters"][2, 0]) + 0.02
        assert bool((seen["hit"].norm(dim=-1) > 0.5).all())
    # And is the same on both, as far as float32 and contacts let it be.
    for name, limit in (("characters", 0.05), ("door", 1e-3), ("box", 5e-3), ("lamp", 5e-3)):
        torch.testing.assert_close(warp[name], cpu[name], rtol=0, atol=limit, msg=name)
    torch.testing.assert_close(warp["ball"], cpu["ball"], rtol=0.1, atol=0.2)
