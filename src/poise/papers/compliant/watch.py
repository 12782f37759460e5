"""What is looked at while a scene is played: forces, arrows, what moves, how far goals gave way."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

import mujoco
import numpy as np
import torch
from torch import Tensor

from poise.env import ImitationEnv
from poise.env.events import ScenePart
from poise.env.goals import DisplacedGoal
from poise.env.plugins import Felt, Plugin
from poise.eval.rolloutset import RolloutSet, judge
from poise.jobs.track.best import RULE
from poise.kin import lowest_height
from poise.metrics import success_rule
from poise.papers.compliant.meters import Meter
from poise.recipes.imitation import Imitation
from poise.sim import CharacterRows
from poise.view import Mover, Shape

#: N; weaker forces do not count as interaction.
LEAST_N = 1.0
#: m; a foot that was higher than the one and is lower than the other has come down: a step.
UP_M, DOWN_M = 0.05, 0.02
_KINDS = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere", int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
}  # fmt: skip


class Watch:
    """What acts on the characters, how hard, and how far their goals gave way.

    meter: of the scene's own figures, None where it has none.
    """

    def __init__(self, meter: Meter | None = None) -> None:
        self.meter = meter
        self.arrows: list[np.ndarray] = []
        self._ways: list[np.ndarray] = []
        self._felt: list[Plugin] = []

    def begin(self, env: ImitationEnv) -> None:
        """Looks at an environment from now on."""
        n = env.num_envs
        self._felt = [p for p in env.plugins if type(p).felt is not Plugin.felt]
        self._step_s = env.substeps * float(env.backend.model.opt.timestep)
        names = ("impulse", "sum", "peak", "acts", "torque", "steps", "moved")
        self._sums = {k: torch.zeros(n, dtype=torch.float64) for k in names}
        env.backend.state.bind(["qfrc_actuator"])
        if self.meter is not None:
            self.meter.begin(env)
        self._shapes = list[tuple[Shape, int]]()
        rows = env.backend
        if not isinstance(rows, CharacterRows) or rows.sim is None:
            return
        model = rows.sim.scene.model
        own = range(rows.places[0].geoms.start, rows.places[0].geoms.stop)
        for g in range(model.ngeom):
            kind, body = _KINDS.get(int(model.geom_type[g])), int(model.geom_bodyid[g])
            if g in own or kind is None or body == 0:
                continue
            size, pos = (
                (float(a), float(b), float(c)) for a, b, c in (model.geom_size[g], model.geom_pos[g])
            )
            w, x, y, z = (float(v) for v in model.geom_quat[g])
            self._shapes.append((Shape(0, kind, size, pos, (w, x, y, z)), body))

    def see(self, env: ImitationEnv, step: int) -> bool:
        """Keeps control step `step`; it never needs more of them."""
        felt = [f for f in (p.felt() for p in self._felt) if f is not None]
        force = torch.stack([f.force.norm(dim=-1).sum(1) for f in felt]).sum(0).double()
        peak, metered = force, env.plugin(ScenePart)
        if metered is not None and "peak/hit" in metered.sources():
            # Physics step by physics step, where it is metered.
            peak = metered.sources()["peak/hit"].double()
            force = metered.sources()["impulse/hit"].double().norm(dim=-1) / self._step_s
        if self.meter is not None:
            self.meter.see(env, step)
        s = self._sums
        acts = peak >= LEAST_N
        if step:
            s["acts"] += acts
            s["sum"] += torch.where(acts, force, 0.0)
            s["impulse"] += force * self._step_s
            s["peak"] = torch.maximum(s["peak"], peak)
            s["torque"] += env.backend.state["qfrc_actuator"][:, 6:].abs().mean(1).double()
            s["steps"] += 1.0
        if isinstance(env.goal, DisplacedGoal):
            was = env.goal.layout.unpacked(env.goal.goal.now()).pos
            way = (env.goal_pose().pos - was).norm(dim=-1).mean(1).double()
            s["moved"] = torch.maximum(s["moved"], way)
        self.arrows.append(_arrows(felt))
        if self._shapes:
            assert isinstance(env.backend, CharacterRows)
            state = env.backend.world.state
            bodies = [b for _, b in self._shapes]
            way = torch.cat((state.xpos[0, bodies], state.xquat[0, bodies]), 1)
            self._ways.append(way.double().cpu().numpy())
        return True

    def movers(self) -> tuple[Mover, ...]:
        """What moved in the first world."""
        if not self._ways:
            return ()
        ways = np.stack(self._ways, 1)
        return tuple(
            Mover(shape, way[:, :3], way[:, 3:])
            for (shape, _), way in zip(self._shapes, ways, strict=True)
        )

    def figures(self, rollouts: RolloutSet, task: Imitation) -> dict[str, float]:
        """The figures, means over the episodes."""
        s = self._sums
        off = (rollouts.pos - rollouts.ref_pos).norm(dim=-1).mean()
        low = lowest_height(task.humanoid.table, rollouts.pos, rollouts.quat)
        lost = (judge(rollouts, success_rule(RULE)).failed_at >= 0).sum()
        found = {
            "force_mean_n": float((s["sum"] / s["acts"].clamp_min(1.0)).mean()),
            "force_peak_n": float(s["peak"].mean()),
            "impulse_ns": float(s["impulse"].mean()),
            "torque_nm": float((s["torque"] / s["steps"].clamp_min(1.0)).mean()),
            "goal_moved_m": float(s["moved"].mean()),
            "steps": float(footfalls(low[..., list(task.humanoid.feet)]).double().mean()),
            "off_m": float(off),
            "lost": float(lost),
        }
        if self.meter is not None:
            found |= self.meter.figures()
        return {k: round(v, 4) for k, v in found.items()}


def footfalls(height: Tensor) -> Tensor:
    """`(E,)` how often feet come down, of the height of their soles `(E, T, F)` m."""
    up = torch.zeros_like(height[:, 0], dtype=torch.bool)
    out = torch.zeros(len(height), dtype=torch.long)
    for t in range(height.shape[1]):
        down = up & (height[:, t] < DOWN_M)
        out += down.sum(1)
        up = (up & ~down) | (height[:, t] > UP_M)
    return out


def _arrows(felt: list[Felt]) -> np.ndarray:
    rows = [torch.cat((f.point[0], f.force[0]), 1).double().cpu().numpy() for f in felt]
    every = np.concatenate(rows) if rows else np.zeros((0, 6))
    return every[np.linalg.norm(every[:, 3:], axis=1) >= LEAST_N]
