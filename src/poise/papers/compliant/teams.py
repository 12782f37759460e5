"""Characters of several bodies or policies in the same worlds: an environment for each, one physics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor

from poise.env.controls import steps
from poise.env.env import ImitationEnv
from poise.env.task import EnvStep
from poise.errors import PoiseError
from poise.machine import one_thread
from poise.sim import CharacterRows


class Teams:
    """Environments that share the N worlds of a scene.

    Each is one body with one policy: its own goal, terms, events and help. They act at the same time,
    and then the worlds are stepped once.

    sim = SceneSim(Scene((Character(tall, "anna"), Character(short, "ben"))), num_envs=16)
    teams = Teams(
        {name: task.env(backend=sim.characters(name), guard=False) for name, task in tasks.items()}
    )
    teams.reset()
    step = teams.step({"anna": ..., "ben": ...})

    Args:
        envs: environments on characters of one `SceneSim`, by name.
        ends: whether episodes end per "character", or for all of a "world" at once: where one ends,
            those of the others are cut off like by a time-out.
    """

    def __init__(
        self, envs: Mapping[str, ImitationEnv], ends: Literal["character", "world"] = "character"
    ):
        if not envs:
            raise PoiseError("teams need at least one environment", "Teams")
        self.envs, self.ends, self._rows = dict(envs), ends, dict[str, CharacterRows]()
        for name, env in envs.items():
            if not isinstance(env.backend, CharacterRows):
                raise PoiseError(
                    "a team's characters are those of a scene",
                    f"Teams '{name}'",
                    "Make its environment with backend=SceneSim(...).characters(...)",
                )
            self._rows[name] = env.backend
        first = next(iter(self._rows.values()))
        self._world = first.world
        if any(rows.world is not self._world for rows in self._rows.values()):
            raise PoiseError("teams act in one scene, these are in several", "Teams")
        claimed = [place.name for rows in self._rows.values() for place in rows.places]
        twice = next((name for name in claimed if claimed.count(name) > 1), None)
        if twice is not None:
            raise PoiseError(f"'{twice}' is in two teams", "Teams")
        self._substeps = {env.substeps for env in envs.values()}
        if len(self._substeps) != 1:
            raise PoiseError("teams need the same physics steps per control step", "Teams")

    @property
    def num_worlds(self) -> int:
        """N."""
        return self._world.num_envs

    def reset(self) -> dict[str, Tensor]:
        """New episodes everywhere; each team's observations."""
        for env in self.envs.values():
            env.reset()
        return {name: env.observe() for name, env in self.envs.items()}

    @one_thread()
    def step(self, actions: Mapping[str, Tensor]) -> dict[str, EnvStep]:
        """One control step for all; `actions` `(N K, A)` of each team."""
        missing = self.envs.keys() ^ actions.keys()
        if missing:
            known = ", ".join(self.envs)
            raise PoiseError(f"'{min(missing)}' has no action or no team", "Teams", f"Teams: {known}")
        for name, env in self.envs.items():
            env.drive(actions[name])
        (substeps,) = self._substeps
        steps([env.controls.actuation for env in self.envs.values()], self._advance, substeps)
        judged = {name: env.judge() for name, env in self.envs.items()}
        if self.ends == "world":
            self._end_together(judged)
        return {name: env.renew(judged[name]) for name, env in self.envs.items()}

    def close(self) -> None:
        """Frees the worlds."""
        self._world.close()

    def _advance(self, count: int) -> None:
        for rows in self._rows.values():
            rows.push()
        self._world.step(count)
        for rows in self._rows.values():
            rows.pull()

    def _end_together(self, judged: Mapping[str, EnvStep]) -> None:
        n = self.num_worlds
        over = torch.zeros(n, dtype=torch.bool, device=self._world.device)
        for step in judged.values():
            over |= (step.terminated | step.truncated).view(n, -1).any(1)
        for step in judged.values():
            many = len(step.terminated) // n
            step.truncated.logical_or_(over.repeat_interleave(many) & ~step.terminated)
