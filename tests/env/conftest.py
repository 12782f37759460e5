"""Environments over the small human."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from poise.env import ImitationEnv
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
            config = replace(ResidualForce(num_envs=4), **settings)  # type: ignore[arg-type]
            from poise.motion import ClipLibrary

            known[key] = build(ClipLibrary(clips or (swing(),)), config)
        return known[key]

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
