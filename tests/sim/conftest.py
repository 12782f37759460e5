"""A small humanoid-like model: a free root, two hinged limbs, a floor."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import pytest
import torch
from torch import Tensor

from poise.sim import SimConfig, add_contact_sensors


def _limb(spec: mujoco.MjSpec, root, side: str, y: float) -> None:
    limb = root.add_body(name=f"limb_{side}", pos=[0.02, y, -0.1])
    joint = limb.add_joint(name=f"hip_{side}", axis=[0.2, 1, 0], damping=[0.5, 0, 0])
    limb.add_geom(
        name=f"limb_{side}", type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, 0.05, 0, -0.35],
        size=[0.05, 0, 0], mass=2.0,
    )  # fmt: skip
    motor = spec.add_actuator(name=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint.name)
    motor.set_to_position(kp=40.0)
    motor.forcelimited, motor.forcerange = True, [-60, 60]


@pytest.fixture
def make_spec() -> Callable[..., mujoco.MjSpec]:
    """`make_spec(gravity=True, floor=True, sensors=False, config=SimConfig())`."""

    def make(
        gravity: bool = True,
        floor: bool = True,
        sensors: bool = False,
        config: SimConfig = SimConfig(),
    ) -> mujoco.MjSpec:
        spec = mujoco.MjSpec()
        if floor:
            spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[9, 9, 0.1])
        root = spec.worldbody.add_body(name="root", pos=[0, 0, 0.6])
        root.add_freejoint(name="root")
        # The geom is off the body's origin, so that xipos and xpos differ.
        root.add_geom(
            name="trunk",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.1, 0.2, 0.08],
            pos=[0.03, 0.02, 0.1],
            mass=6,
        )
        _limb(spec, root, "left", 0.2)
        _limb(spec, root, "right", -0.2)
        config.apply(spec)
        if not gravity:
            spec.option.gravity = [0, 0, 0]
        if sensors:
            add_contact_sensors(spec)
        return spec

    return make


@pytest.fixture
def random_state() -> Callable[..., tuple[Tensor, Tensor]]:
    """`random_state(model, n, seed=0, height=0.7)`: qpos `(n, nq)` and qvel `(n, nv)`, float64."""

    def make(model: mujoco.MjModel, n: int, seed: int = 0, height: float = 0.7) -> tuple[Tensor, Tensor]:
        rng = torch.Generator().manual_seed(seed)
        qpos = 0.3 * torch.randn(n, model.nq, generator=rng, dtype=torch.float64)
        qpos[:, 2] = height
        qpos[:, 3] += 1.0
        qpos[:, 3:7] /= qpos[:, 3:7].norm(dim=1, keepdim=True)
        return qpos, torch.randn(n, model.nv, generator=rng, dtype=torch.float64)

    return make
