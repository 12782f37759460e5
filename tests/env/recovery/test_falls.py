"""Characters that lie on the floor: at rest, in contact, not deep in it, and the same for a seed."""

from __future__ import annotations

import mujoco
import pytest
import torch

from poise.env.recovery.falls import Drop, fall_states, lies, standing_height
from poise.sim import CpuBackend
from refusals import refused
from toy_human import swing


@pytest.mark.parametrize(
    "drop", [Drop(count=7), Drop("action", 0.5, count=7)], ids=["torques", "action"]
)
def test_the_fallen_lie_on_the_floor(make_phc, drop):
    built = make_phc(swing())
    humanoid, pd = built.humanoid, built.task.pd
    backend = CpuBackend(built.model, 3, 1)
    before = backend.snapshot()
    states = fall_states(backend, humanoid, pd, drop, seed=1)
    assert states.shape == (7, humanoid.model.nq) and states.isfinite().all()
    assert torch.equal(before, backend.snapshot())  # The worlds come back as they were.
    assert bool(lies(humanoid, states).all()) and not states[:, :2].any()
    assert float(states[:, 2].max()) < 0.6 * standing_height(humanoid)
    # MuJoCo itself finds every body touching the floor and none deep in anything.
    model = built.model
    data = mujoco.MjData(model)
    for q in states:
        data.qpos[:] = q.numpy()
        mujoco.mj_forward(model, data)
        floor = (data.contact.geom == 0).any(1)
        assert floor.any() and data.contact.dist[floor].min() > -0.031
    # As many worlds as one likes give the same states; another seed gives others.
    other = CpuBackend(built.model, 5, 1)
    assert torch.equal(states, fall_states(other, humanoid, pd, drop, seed=1))
    assert not torch.equal(states, fall_states(other, humanoid, pd, drop, seed=2))


def test_who_does_not_come_to_lie_is_told(make_phc):
    built = make_phc(swing())
    backend = CpuBackend(built.model, 4, 1)
    with refused("fall-unsettled"):
        fall_states(backend, built.humanoid, built.task.pd, Drop(steps=2, count=4))
    upright = torch.zeros(2, built.humanoid.model.nq, dtype=torch.float64)
    upright[:, 3] = 1.0
    upright[1, 2] = torch.nan
    assert lies(built.humanoid, upright).tolist() == [False, False]
