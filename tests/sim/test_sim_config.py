"""Physics settings: defaults, application, mistakes."""

from __future__ import annotations

import mujoco
import pytest

from poise.sim import INTEGRATORS, SimConfig, add_contact_sensors
from refusals import refused


def test_steps_per_control_step():
    assert (SimConfig().substeps, SimConfig(450, 30).substeps, SimConfig(120, 60).substeps) == (2, 15, 2)
    assert SimConfig(rate_hz=450).timestep == 1 / 450


@pytest.mark.parametrize("name", list(INTEGRATORS))
def test_apply_reaches_spec_and_model(name):
    config = SimConfig(rate_hz=120, integrator=name, solver="cg", cone="elliptic", iterations=7)
    spec = mujoco.MjSpec()
    config.apply(spec)
    model, other = spec.compile(), mujoco.MjSpec().compile()
    config.apply(other)
    for m in (model, other):
        assert m.opt.timestep == 1 / 120 and m.opt.integrator == INTEGRATORS[name]
        assert (m.opt.solver, m.opt.cone, m.opt.iterations) == (mujoco.mjtSolver.mjSOL_CG, 1, 7)


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"rate_hz": 100}, ("not-a-multiple", ("3.333", "rate_hz=90"))),
        ({"rate_hz": 20}, ("not-a-multiple", ("0.6667", "rate_hz=30"))),
        ({"integrator": "discret"}, ("unknown-choice", ("integrator", "discret"))),
        ({"cone": "round"}, ("unknown-choice", ("cone", "round"))),
        ({"rate_hz": 0}, ("out-of-range", ("rate_hz", "0"))),
        ({"control_hz": float("nan")}, ("out-of-range", ("control_hz", "nan"))),
        ({"iterations": -1}, ("out-of-range", ("iterations", "-1"))),
    ],
)
def test_bad_settings(settings, message):
    with refused(*message):
        SimConfig(**settings)


def test_contact_sensors_need_a_body_that_exists(make_spec):
    spec = make_spec()
    with refused("unknown-body", says=("limb_lef", "limb_left")):
        add_contact_sensors(spec, ["limb_lef"])
    add_contact_sensors(spec, ["limb_left"], against="world")
    assert spec.compile().nsensordata == 3
