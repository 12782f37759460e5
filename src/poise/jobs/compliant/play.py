"""Scenes played by a trained policy: with compliance and without, side by side in figures.

played = play(Hands(), clip=read_clip("walk.bvh"), given=Stiffness(200.0))
played.figures["force_mean_n"], played.write(Path("out"))
"""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import torch
from torch import Tensor

from poise.control import Compliance, Stiffness
from poise.env import ImitationEnv
from poise.env.events import ScenePart
from poise.env.goals import DisplacedGoal
from poise.env.plugins import Felt, Plugin
from poise.env.scenes import PlayScene
from poise.eval import run_episodes, write_score
from poise.eval.rolloutset import RolloutSet, judge
from poise.jobs.compliant.standing import standing
from poise.jobs.deliver import make_report, simulated_clip
from poise.jobs.open import open_run
from poise.jobs.runs import Evaluation, scored
from poise.jobs.track import imitation_of
from poise.jobs.track.controllers import RULE
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.kin import lowest_height
from poise.metrics import success_rule
from poise.motion import Clip
from poise.motion.io import write_clip
from poise.recipes.imitation import Imitation
from poise.sim import CharacterRows
from poise.view import Mover, Shape, write_report

#: N; weaker forces do not count as interaction.
LEAST_N = 1.0
#: m; a foot that was higher than the one and is lower than the other has come down: a step.
UP_M, DOWN_M = 0.05, 0.02
#: What the figures are, in words.
WORDS = {
    "force_mean_n": "Interaction force, mean while it acts, N",
    "force_peak_n": "Interaction force, greatest, N",
    "impulse_ns": "Interaction impulse, N s",
    "torque_nm": "Servos' torque, mean of the hinges, N m",
    "goal_moved_m": "Goal gave way, most of its bodies' mean, m",
    "steps": "Steps of both feet",
    "off_m": "Distance from the goal, mean, m",
    "lost": "Episodes lost",
}
_KINDS = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere", int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Played:
    """What came of a scene.

    Attributes:
        scene: its name.
        imitation: the task of the compliant character.
        evaluation: its episodes and score.
        figures, stiff: by the keys of `WORDS`, of the compliant character and of its twin that does not
            give way; means over the episodes, `lost` their count.
        count: of the episodes of each.
        arrows: of each frame of the first episode `(K, 6)`: points, m, and forces felt there, N.
        movers: what moves in its world.
    """

    scene: str
    imitation: Imitation
    evaluation: Evaluation
    figures: Mapping[str, float]
    stiff: Mapping[str, float]
    count: int
    arrows: tuple[np.ndarray, ...]
    movers: tuple[Mover, ...]

    @property
    def clip(self) -> Clip:
        """The first episode's motion on the policy's skeleton."""
        return simulated_clip(self.imitation, self.evaluation)

    def sentence(self) -> str:
        """What the compliance changed, in words."""
        a, b = self.figures["force_mean_n"], self.stiff["force_mean_n"]
        share = 1.0 if b == 0.0 else a / b
        less = f"{abs(1.0 - share):.0%} {'less' if share < 1.0 else 'more'}"
        lost, others = (f"{f['lost']:.0f}" for f in (self.figures, self.stiff))
        return (
            f"{self.count} episodes: the interaction force is {a:.1f} N on average, {less} than without "
            f"compliance ({b:.1f} N); {lost} were lost, {others} without."
        )

    def write(self, out: Path) -> dict[str, Path]:
        """`simulated.bvh`, `score.json`, `figures.json` and `report.html` in a folder."""
        out.mkdir(parents=True, exist_ok=True)
        paths = {k: out / n for k, n in (("simulated", "simulated.bvh"), ("figures", "figures.json"))}
        write_clip(self.clip, paths["simulated"])
        told = {"scene": self.scene, "episodes": self.count, "compliant": dict(self.figures),
                "without": dict(self.stiff)}  # fmt: skip
        paths["figures"].write_text(json.dumps(told, indent=1) + "\n")
        paths["score"] = write_score(self.evaluation.card, out / "score.json")
        report = make_report(self.imitation, self.evaluation, {})
        frames = len(report.reference.pos)
        report = replace(
            report, title=f"{self.scene}, {report.title}", movers=self.movers,
            pushes=self.arrows if len(self.arrows) == frames else (),
            notes=(self.sentence(), *report.notes),
        )  # fmt: skip
        paths["report"] = out / "report.html"
        write_report(report, paths["report"])
        return paths


def play(
    scene: PlayScene,
    policy: Tracker | str | Path | None = None,
    clip: Clip | None = None,
    given: Compliance | Stiffness | None = None,
    count: int = 16,
    seconds: float = 8.0,
    threads: int = 0,
    name: str = "",
) -> Played:
    """A scene with compliance and without, by the policy alone, from starts that differ by a hair.

    Args:
        policy: see `poise.track`.
        clip: what the character does; None stands at ease for so many `seconds`.
        given: how it gives way; None is Compliance().
        count: of episodes, side by side.
        name: of the scene, by default that of its class.

    Raises:
        PoiseError: the body cannot do the scene, or the clip cannot be read.
    """
    tracker = policy if isinstance(policy, Tracker) else open_run(policy).tracker
    task = standing(tracker, seconds) if clip is None else imitation_of(tracker, [place(clip, tracker)])
    stage = scene.stage(task.humanoid, task.reference)
    task = replace(task, props=stage.props, links=stage.links, touches=stage.touches)
    both: list[tuple[Imitation, RolloutSet, _Watch, Evaluation]] = []
    for compliance in (given or Compliance(), None):
        own = replace(task.task, plugins=stage.plugins, compliance=compliance, help_by="all")
        both.append(_episodes(tracker, replace(task, task=own), count, threads))
    (imitation, rollouts, seen, evaluation), (_, others, other, _) = both
    return Played(
        name or type(scene).__name__.lower(), imitation, evaluation,
        seen.figures(rollouts, task), other.figures(others, task), count,
        tuple(seen.arrows), seen.movers(),
    )  # fmt: skip


def _episodes(
    tracker: Tracker, task: Imitation, count: int, threads: int
) -> tuple[Imitation, RolloutSet, _Watch, Evaluation]:
    zero, watch = torch.zeros(count, dtype=torch.long), _Watch()

    def make(worlds: int) -> ImitationEnv:
        env = task.env(worlds, None, False, threads, help_scale=0.0, guard=False)
        watch.begin(env)
        return env

    rollouts, recordings = run_episodes(
        make, tracker.policy, zero, zero, cycles=1, observers=[watch], trial=torch.arange(count)
    )
    card = scored(rollouts, task, tracker.about, RULE, tracker.config.method)
    return task, rollouts, watch, Evaluation(card, rollouts, recordings, False)


class _Watch:
    """What acts on the characters, how hard, and how far their goals gave way."""

    def __init__(self) -> None:
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
