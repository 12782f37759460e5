"""A body written as MJCF: MuJoCo loads it, it falls alike, Poise reads it again."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from poise.body import BodyConfig, Humanoid
from poise.kinematics import fit_humanoid
from poise.sim import SimConfig, alone
from poise.sim.scene import mjcf_of, write_mjcf
from toy_policy import walk

#: Arrays of a model that say what it is; MJCF holds six digits.
FIELDS = (
    *("body_mass", "body_inertia", "body_pos", "body_quat", "dof_damping", "dof_armature", "jnt_range"),
    *("actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "geom_size", "geom_friction"),
)


@pytest.fixture(scope="module")
def humanoid() -> Humanoid:
    return fit_humanoid(walk())[0]


def test_mujoco_loads_the_same_model(humanoid: Humanoid, tmp_path: Path) -> None:
    path = write_mjcf(humanoid, tmp_path / "body.xml")
    own, read = alone(humanoid), mujoco.MjModel.from_xml_path(str(path))
    assert (read.nq, read.nv, read.nu, read.nbody, read.ngeom, read.nexclude) == (
        own.nq, own.nv, own.nu, own.nbody, own.ngeom, own.nexclude,
    )  # fmt: skip
    for name in FIELDS:
        a, b = getattr(own, name), getattr(read, name)
        assert np.allclose(a, b, rtol=2e-5, atol=2e-6), name
    assert (own.opt.integrator, own.opt.iterations) == (read.opt.integrator, read.opt.iterations)
    names = [mujoco.mj_id2name(read, mujoco.mjtObj.mjOBJ_BODY, k + 1) for k in range(read.nbody - 1)]
    assert tuple(names) == humanoid.bodies


def test_it_falls_as_the_one_that_is_simulated(humanoid: Humanoid) -> None:
    places = []
    for model in (alone(humanoid), mujoco.MjModel.from_xml_string(mjcf_of(humanoid))):
        data = mujoco.MjData(model)
        data.qpos[2] = 2.0
        for _ in range(12):
            mujoco.mj_step(model, data)
        places.append(data.xpos.copy())
    assert np.abs(places[0] - places[1]).max() < 1e-3
    # And it did fall, by g t^2 / 2.
    assert places[0][1, 2] < 1.9


def test_settings_of_the_physics_are_in_it(humanoid: Humanoid) -> None:
    read = mujoco.MjModel.from_xml_string(mjcf_of(humanoid, SimConfig(rate_hz=120)))
    assert read.opt.timestep == pytest.approx(1 / 120, rel=1e-4)


def test_poise_takes_it_as_a_body_of_its_own(humanoid: Humanoid, tmp_path: Path) -> None:
    path = write_mjcf(humanoid, tmp_path / "body.xml")
    again, _, _ = fit_humanoid(walk(), BodyConfig(mjcf=str(path)))
    assert again.bodies == humanoid.bodies and len(again.hinges) == len(humanoid.hinges)
    assert again.mass == pytest.approx(humanoid.mass, rel=1e-4)
