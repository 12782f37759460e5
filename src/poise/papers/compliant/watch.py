"""Observers of a scene while it is played: forces, moving things, how far goals gave way."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import mujoco
import numpy as np
import torch
from torch import Tensor

from poise.env import ImitationEnv
from poise.env.events import Felt, Force
from poise.env.recovery.recovering import Recovering
from poise.env.scene_events import ScenePart
from poise.env.yielding import DisplacedGoal
from poise.jobs.result import RULE
from poise.kinematics import lowest_height
from poise.metrics import success_rule
from poise.papers.compliant.figures import FALLEN, TOUCHES_N
from poise.papers.compliant.opponents import Opponent
from poise.papers.compliant.scenes import Balance, Chicken, DoorScene, PlayScene, TrampolineScene
from poise.papers.compliant.scenes.ball import COS_45, upright_of
from poise.papers.compliant.scenes.body_scenes import ONE_LEG_S, SOLE_M, Bounce, LiftedFoot
from poise.papers.compliant.scenes.door import WANTED, across
from poise.recipes.imitation import Imitation
from poise.score.report import Mover, Shape
from poise.score.rollouts import RolloutSet, judge
from poise.sim import CharacterRows, Mechanics


class Meter(Protocol):
    """Looks at the environments of a scene, and has figures `(E,)` of the episodes at the end; NaN where
    an episode has none."""

    words: Mapping[str, str]
    """What the figures are, by their keys."""

    def begin(self, env: ImitationEnv) -> None:
        """Looks at an environment from now on."""
        ...

    def see(self, env: ImitationEnv, step: int) -> None:
        """Control step `step` has been made; 0 is before the first one."""
        ...

    def figures(self) -> dict[str, Tensor]:
        """Of all that was seen."""
        ...


def part_of(env: ImitationEnv) -> ScenePart:
    """An environment's part in its scene."""
    part = env.event(ScenePart)
    assert part is not None
    return part


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
        self._felt: list[Force] = []
        self._recovering: Recovering | None = None

    def begin(self, env: ImitationEnv) -> None:
        """Looks at an environment from now on."""
        n = env.num_envs
        self._felt = [event for event in env.events if isinstance(event, Force)]
        goal = env.goal.goal if isinstance(env.goal, DisplacedGoal) else env.goal
        self._recovering = goal if isinstance(goal, Recovering) else None
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
        force = torch.zeros(env.num_envs, dtype=torch.float64, device=env.device)
        for one in felt:
            force = force + one.force.norm(dim=-1).sum(1).double()
        peak, metered = force, env.event(ScenePart)
        if metered is not None and "peak/hit" in metered.tells():
            # Physics step by physics step, where it is metered.
            peak = metered.tells()["peak/hit"].double()
            force = metered.tells()["impulse/hit"].double().norm(dim=-1) / self._step_s
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

    def figures(self, rollouts: RolloutSet, task: Imitation) -> dict[str, Tensor]:
        """The figures `(E,)` of each episode."""
        s = self._sums
        off = (rollouts.pos - rollouts.ref_pos).norm(dim=-1).mean((1, 2))
        low = lowest_height(task.humanoid.table, rollouts.pos, rollouts.quat)
        lost = judge(rollouts, success_rule(RULE)).failed_at >= 0
        found = {
            "force_mean_n": s["sum"] / s["acts"].clamp_min(1.0),
            "force_peak_n": s["peak"],
            "impulse_ns": s["impulse"],
            "torque_nm": s["torque"] / s["steps"].clamp_min(1.0),
            "goal_moved_m": s["moved"],
            "steps": footfalls(low[..., list(task.humanoid.feet)]),
            "off_m": off,
            "lost": lost,
        }
        if self._recovering is not None:
            found |= falls_of(self._recovering)
        if self.meter is not None:
            found |= self.meter.figures()
        return {k: v.double().cpu() for k, v in found.items()}

    @property
    def words(self) -> Mapping[str, str]:
        """What figures are that not all scenes have."""
        own = {} if self.meter is None else self.meter.words
        return own if self._recovering is None else {**FALLS_WORDS, **own}


#: What falls are where a character gets up, in words.
FALLS_WORDS = {"falls": "Times that a character lost its motion", "up_again": "Times that it came back"}


def falls_of(goal: Recovering) -> dict[str, Tensor]:
    """How often each world's character lost its motion, and came back to it, `(E,)`."""
    worlds = {"falls": goal.lost, "up_again": goal.back}
    return {
        k: torch.tensor([i for i, _ in v], dtype=torch.long).bincount(minlength=goal.num_envs)
        for k, v in worlds.items()
    }


def footfalls(height: Tensor, lifted: float = UP_M) -> Tensor:
    """`(E,)` how often feet come down that were higher than `lifted`, of the height of their soles
    `(E, T, F)` m."""
    up = torch.zeros_like(height[:, 0], dtype=torch.bool)
    out = torch.zeros(len(height), dtype=torch.long)
    for t in range(height.shape[1]):
        down = up & (height[:, t] < DOWN_M)
        out += down.sum(1)
        up = (up & ~down) | (height[:, t] > lifted)
    return out


def _arrows(felt: list[Felt]) -> np.ndarray:
    rows = [torch.cat((f.point[0], f.force[0]), 1).double().cpu().numpy() for f in felt]
    every = np.concatenate(rows) if rows else np.zeros((0, 6))
    return every[np.linalg.norm(every[:, 3:], axis=1) >= LEAST_N]


G = 9.81
#: s after the first touch at which it is looked how far a player was pushed.
PUSHED_S = 0.5


class DoorMeter:
    """The force of the knob's weld along and across the knob's way, and how far the door opens."""

    words: Mapping[str, str] = {
        "across_n": "Force across the knob's way, mean while the hand is welded to it, N",
        "along_n": "Force along the knob's way, mean, N",
        "angle_rad": "Door opened, most while the hand held it, rad",
        "opened": f"Episodes in which it was opened to {WANTED:g} rad",
    }

    def begin(self, env: ImitationEnv) -> None:
        self._part = part_of(env)
        self._sim = self._part.sim
        self._sums = torch.zeros(3, env.num_envs, dtype=torch.float64)
        self._angle = torch.zeros(env.num_envs, dtype=torch.float64)

    def see(self, env: ImitationEnv, step: int) -> None:
        state = self._sim.backend.state
        on = state["eq_active"][:, 0].double()
        force = self._sim.link("grip").force.double()
        wide = across(self._part, force)
        self._sums += on * torch.stack((on, wide.norm(dim=-1), (force - wide).norm(dim=-1)))
        angle = -state.qpos[:, self._sim.scene.place("door").qpos.start].double()
        self._angle = torch.maximum(self._angle, on * angle)

    def figures(self) -> dict[str, Tensor]:
        count, wide, along = self._sums
        return {
            "across_n": wide / count.clamp_min(1.0),
            "along_n": along / count.clamp_min(1.0),
            "angle_rad": self._angle,
            "opened": self._angle >= WANTED,
        }


class TrampolineMeter:
    """What the paper looks at on a trampoline: how low the feet come, and the character's energy."""

    words: Mapping[str, str] = {
        "foot_low_m": "Lowest foot of a landing against where it stood at first, mean, m",
        "plate_m": "Plate, greatest less lowest height after the first bounce, m",
        "energy_j": "Energy of the character in the second after a landing, mean, J",
    }

    def begin(self, env: ImitationEnv) -> None:
        part = part_of(env)
        self._bounce = next(h for h in part.events if isinstance(h, Bounce))
        self._sim, self._mechanics = part.sim, Mechanics(env.backend)
        self._feet = list(env.goal.humanoid.feet)
        n = env.num_envs
        self._low, self._lows, self._landings, self._joules, self._steps = (
            torch.zeros(n, dtype=torch.float64) for _ in range(5)
        )
        self._plate = torch.full((2, n), -torch.inf, dtype=torch.float64)

    def see(self, env: ImitationEnv, step: int) -> None:
        pose, state = env.pose(), env.backend.state
        foot, com = pose.pos[:, self._feet, 2].amin(1).double(), pose.com[:, 2].double()
        if step == 0:
            self._stood, self._com = foot.clone(), com.clone()
        # A landing is over with the second in which it gives way.
        lands = self._bounce.gives > 0
        self._low = torch.where(lands, torch.minimum(self._low, foot - self._stood), self._low)
        ends = self._bounce.gives == 1
        self._lows += torch.where(ends, self._low, 0.0)
        self._low[ends] = 0.0
        self._landings += ends
        qvel = state.qvel.double()
        kinetic = 0.5 * torch.einsum("ni,nij,nj->n", qvel, self._mechanics.inertia().double(), qvel)
        # E = q'^T M q' / 2 + m g (z - z_0)
        energy = kinetic + env.goal.humanoid.mass * G * (com - self._com)
        self._joules += torch.where(lands, energy, 0.0)
        self._steps += lands
        if step / env.goal.rate_hz > self._bounce.first:
            height = self._sim.backend.state.qpos[:, self._sim.scene.place("trampoline").qpos.start]
            self._plate = torch.maximum(self._plate, torch.stack((height, -height)).double())

    def figures(self) -> dict[str, Tensor]:
        return {
            "foot_low_m": self._lows / self._landings.clamp_min(1.0),
            "plate_m": self._plate.sum(0).clamp_min(0.0),
            "energy_j": self._joules / self._steps.clamp_min(1.0),
        }


class BallMeter:
    """How long the ball stays above the head."""

    words: Mapping[str, str] = {
        "stays_s": "Ball stays above the head, its rod less than 45 degrees from upright, mean, s",
        "tilt_deg": "Tilt of the rod while the ball stays, mean, degrees",
    }

    def begin(self, env: ImitationEnv) -> None:
        self._part = part_of(env)
        n = env.num_envs
        self._up = torch.ones(n, dtype=torch.bool)
        self._sums = torch.zeros(2, n, dtype=torch.float64)

    def see(self, env: ImitationEnv, step: int) -> None:
        upright = upright_of(self._part.sim)
        self._up &= upright > COS_45
        tilt = upright.clamp(-1.0, 1.0).acos()
        self._sums += self._up * torch.stack((torch.ones_like(tilt), tilt))
        self._rate = env.goal.rate_hz

    def figures(self) -> dict[str, Tensor]:
        stays, tilt = self._sums
        return {
            "stays_s": stays / self._rate,
            "tilt_deg": (tilt / stays.clamp_min(1.0)).rad2deg(),
        }


class ChickenMeter:
    """How far a blow pushes a player off, and its opponent, where that is one."""

    words: Mapping[str, str] = {
        "pushed_mm": f"Pelvis pushed off its way in {PUSHED_S:g} s from the first touch on, mean, mm",
        "rival_pushed_mm": "The same of its opponent, mm",
        "touched": "Episodes with a touch",
        "rival_fell": "Episodes in which the opponent fell",
        "one_leg_s": "On one leg until the other foot is put down, s",
        "one_leg": "Episodes on one leg to the end",
    }

    def begin(self, env: ImitationEnv) -> None:
        self._part = part_of(env)
        opposing = env.event(Opponent)
        self._envs = [env] if opposing is None else [env, opposing.env]
        n = env.num_envs
        self._left = torch.full((n,), -1, dtype=torch.long)
        self._from = torch.zeros(len(self._envs), n, 2)
        self._way = torch.zeros(len(self._envs), n)
        self._fell = torch.zeros(n, dtype=torch.bool)
        self._foot = LiftedFoot(env.goal.humanoid)
        self._one_leg, self._hops = torch.ones(n, dtype=torch.bool), torch.zeros(n)

    def see(self, env: ImitationEnv, step: int) -> None:
        pose, rate = env.pose(), env.goal.rate_hz
        if step >= ONE_LEG_S * rate:
            self._one_leg &= self._foot.height(pose.pos, pose.quat) >= SOLE_M
            self._hops += self._one_leg / rate
        off = torch.stack([_off(e) for e in self._envs])
        felt = self._part.felt()
        assert felt is not None
        touched = (felt.force.norm(dim=-1) > TOUCHES_N).any(1)
        begins = touched & (self._left < 0)
        self._from[:, begins] = off[:, begins]
        self._left[begins] = round(PUSHED_S * env.goal.rate_hz)
        ends = self._left == 1
        self._way[:, ends] = (off - self._from).norm(dim=-1)[:, ends]
        self._left = torch.where(self._left > 0, self._left - 1, self._left)
        if len(self._envs) > 1:
            height = self._envs[1].pose().pos[:, 0, 2]
            if step == 0:
                self._stood = height.clone()
            self._fell |= height < FALLEN * self._stood

    def figures(self) -> dict[str, Tensor]:
        way = 1000.0 * self._way.where(self._left == 0, torch.nan)
        found = {
            "pushed_mm": way[0],
            "touched": self._left >= 0,
            "one_leg_s": self._hops,
            "one_leg": self._one_leg,
        }
        return found if len(way) == 1 else {**found, "rival_pushed_mm": way[1], "rival_fell": self._fell}


def _off(env: ImitationEnv) -> Tensor:
    """`(N, 2)` m, the pelvis from where the motion has it, which does not give way."""
    goal = env.goal.goal if isinstance(env.goal, DisplacedGoal) else env.goal
    return (env.pose().pos[:, 0] - goal.layout.unpacked(goal.now()).pos[:, 0])[:, :2]


METERS: Mapping[type[PlayScene], Callable[[], Meter]] = {
    DoorScene: DoorMeter,
    TrampolineScene: TrampolineMeter,
    Balance: BallMeter,
    Chicken: ChickenMeter,
}


def meter_of(scene: PlayScene) -> Meter | None:
    """The meter of a scene, None where it has no figures of its own."""
    make = METERS.get(type(scene))
    return None if make is None else make()
