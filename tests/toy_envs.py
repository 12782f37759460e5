"""Environments over the small human."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from poise.control import PDTargets, range_scale
from poise.env import DoneTerm, ImitationEnv, ObsTerm
from poise.env import observations as obs
from poise.env import rewards as reward
from poise.motion import Clip
from poise.recipes import ResidualForce, build
from poise.recipes.imitation import Imitation
from toy_human import swing


@pytest.fixture(scope="session")
def make_task() -> Callable[..., Imitation]:
    """`make_task(*clips, **settings)`: the built task of a clip or several; built once per setting."""
    known: dict[tuple, Imitation] = {}

    def make(*clips: Clip, **settings: object) -> Imitation:
        key = (tuple((c.name, c.frames, c.cyclic) for c in clips), repr(sorted(settings.items())))
        if key not in known:
            # Constant help, so that no test of the environment depends on a schedule.
            plain = ResidualForce(num_envs=4, help_limit=100.0, help_start=None)
            config = replace(plain, **settings)  # type: ignore[arg-type]
            from poise.motion import ClipLibrary

            known[key] = build(ClipLibrary(clips or (swing(),)), config)
        return known[key]

    return make


@pytest.fixture(scope="session")
def make_phc(make_task: Callable[..., Imitation]) -> Callable[..., Imitation]:
    """`make_phc(*clips)`: rotation goal, Eq. 2, energy, relaxed ends, absolute actions and a style."""

    def make(*clips: Clip) -> Imitation:
        built = make_task(*clips, method="deepmimic")
        humanoid = built.humanoid
        apart = {"bodies": reward.all_but_feet(humanoid), "grace": 1}
        task = replace(
            built.task,
            obs=(ObsTerm("self", obs.self_state), ObsTerm("goal", obs.rotation_goal)),
            rewards=(*reward.imitation_terms(), reward.energy_term()),
            dones=(DoneTerm("any_body_too_far", reward.any_body_too_far, apart),),
            pd=PDTargets("absolute", range_scale(torch.tensor(humanoid.model.jnt_range[1:]))),
            style=obs.style_terms(humanoid),
        )
        return replace(built, task=task)

    return make


@pytest.fixture
def make_env(make_task: Callable[..., Imitation]) -> Callable[..., ImitationEnv]:
    """`make_env(num_envs, seed, auto_reset, threads, clips=(), **settings)`."""

    def make(
        num_envs: int = 4,
        seed: int = 0,
        auto_reset: bool = True,
        threads: int = 1,
        clips: tuple[Clip, ...] = (),
        **settings: object,
    ) -> ImitationEnv:
        return make_task(*clips, **settings).env(num_envs, seed, auto_reset, threads)

    return make
