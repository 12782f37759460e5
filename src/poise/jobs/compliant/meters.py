"""Figures that a scene has of its own, in the paper's terms."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import torch

from poise.env import ImitationEnv
from poise.env.events import ScenePart
from poise.env.scenes import Doorway, PlayScene
from poise.env.scenes.door import WANTED, across
from poise.sim import SceneSim


class Meter(Protocol):
    """Looks at the environments of a scene, and has figures at the end: means over the episodes."""

    words: Mapping[str, str]
    """What the figures are, by their keys."""

    def begin(self, env: ImitationEnv) -> None:
        """Looks at an environment from now on."""
        ...

    def see(self, env: ImitationEnv, step: int) -> None:
        """Control step `step` has been made; 0 is before the first one."""
        ...

    def figures(self) -> dict[str, float]:
        """What was seen."""
        ...


class DoorMeter:
    """The force of the knob's weld along and across the knob's way, and how far the door opens."""

    words: Mapping[str, str] = {
        "across_n": "Force across the knob's way, mean while the hand is welded to it, N",
        "along_n": "Force along the knob's way, mean, N",
        "angle_rad": "Door opened, most while the hand held it, rad",
        "opened": f"Episodes in which it was opened to {WANTED:g} rad",
    }

    def begin(self, env: ImitationEnv) -> None:
        self._sim = scene_of(env)
        self._sums = torch.zeros(3, env.num_envs, dtype=torch.float64)
        self._angle = torch.zeros(env.num_envs, dtype=torch.float64)

    def see(self, env: ImitationEnv, step: int) -> None:
        state = self._sim.backend.state
        on = state["eq_active"][:, 0].double()
        force = self._sim.link("grip").force.double()
        wide = across(self._sim, force)
        self._sums += on * torch.stack((on, wide.norm(dim=-1), (force - wide).norm(dim=-1)))
        angle = -state.qpos[:, self._sim.scene.place("door").qpos.start].double()
        self._angle = torch.maximum(self._angle, on * angle)

    def figures(self) -> dict[str, float]:
        count, wide, along = self._sums
        return {
            "across_n": float((wide / count.clamp_min(1.0)).mean()),
            "along_n": float((along / count.clamp_min(1.0)).mean()),
            "angle_rad": float(self._angle.mean()),
            "opened": float((self._angle >= WANTED).sum()),
        }


METERS: Mapping[type[PlayScene], Callable[[], Meter]] = {Doorway: DoorMeter}


def meter_of(scene: PlayScene) -> Meter | None:
    """The meter of a scene, None where it has no figures of its own."""
    make = METERS.get(type(scene))
    return None if make is None else make()


def words_of(scene: PlayScene) -> Mapping[str, str]:
    """What the figures of a scene's own are."""
    made = meter_of(scene)
    return {} if made is None else made.words


def scene_of(env: ImitationEnv) -> SceneSim:
    """The worlds of an environment in a scene."""
    part = env.plugin(ScenePart)
    assert part is not None
    return part.sim
