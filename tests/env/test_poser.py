"""Poses of coordinates: many at once are those of each alone."""

from __future__ import annotations

from dataclasses import fields

import pytest
import torch

from poise.env.reference import MANY, Poser
from poise.motion import ClipLibrary
from poise.recipes import ResidualForce, build
from toy_human import swing


@pytest.fixture(scope="module")
def poser() -> Poser:
    library = ClipLibrary.of([swing(1.5)])
    return Poser(build(library, ResidualForce(num_envs=2, expert=False)).humanoid)


@pytest.mark.parametrize("frames", [0, 1, MANY - 1, MANY, 2 * MANY + 3])
def test_many_poses_are_those_of_each_frame_alone_to_the_bit(poser: Poser, frames: int) -> None:
    model, rng = poser.humanoid.model, torch.Generator().manual_seed(0)
    qpos = 0.3 * torch.randn(frames, model.nq, generator=rng, dtype=torch.float64)
    qpos[:, 3:7] /= qpos[:, 3:7].norm(dim=1, keepdim=True)
    qvel = torch.randn(frames, model.nv, generator=rng, dtype=torch.float64)
    many, torchs = poser.live(qpos, qvel), poser(qpos, qvel)
    for field in fields(many):
        value, twin = getattr(many, field.name), getattr(torchs, field.name)
        assert value.shape == twin.shape and value.dtype == torch.float32
        torch.testing.assert_close(value, twin, rtol=0, atol=1e-5)
    for i in range(frames):
        alone = poser.live(qpos[i : i + 1], qvel[i : i + 1])
        for field in fields(many):
            assert torch.equal(getattr(many, field.name)[i], getattr(alone, field.name)[0]), field.name
