"""The base of every imitation recipe: a built task that can be trained and watched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import mujoco
from torch import Tensor

from poise.body import BodyConfig, BodyTable, Humanoid
from poise.env import ImitationEnv, Reference, TaskConfig
from poise.env.goal import Goal
from poise.env.recovery.get_up import RecoveryClips
from poise.errors import PoiseError
from poise.kinematics import FitReport, fit_humanoid
from poise.kinematics.place import calm_library, on_own_body
from poise.kinematics.rate import read_clip
from poise.learn import Amp, AmpConfig, LessonConfig, PPOConfig, Trainer, VecEnv, WarmStart
from poise.learn.parallel import ALONE, Comm, rank_seed, share_of
from poise.learn.protocols import Lessons, Style
from poise.machine import cores as machine_cores
from poise.motion import Clip, ClipLibrary
from poise.plan import LookaheadTeacher, TeacherConfig
from poise.sim import (
    Backend,
    Character,
    Floor,
    Link,
    NanGuard,
    Plane,
    Scene,
    SceneSim,
    Touch,
    alone,
    make_backend,
)
from poise.sim.props import Prop

#: What a recipe is built of: a clip, the file of one, or a library.
Clips = Clip | ClipLibrary | str | Path


def as_library(clips: Clips) -> ClipLibrary:
    """A library as it is, or of one clip or motion file.

    Raises:
        PoiseError: neither of them, or a file that cannot be read.
    """
    if isinstance(clips, ClipLibrary):
        return clips
    clip = read_clip(clips) if isinstance(clips, str | Path) else clips
    if not isinstance(clip, Clip):
        what = f"a recipe is built of a clip, a motion file or a ClipLibrary, got {type(clip).__name__}"
        raise PoiseError(what, hint="Put several clips into ClipLibrary.of([...])", code="wrong-type")
    return ClipLibrary.of(clip)


def fitted(
    clips: Clips, body: BodyConfig, rate_hz: float, table: BodyTable | None = None, widens: bool = True
) -> tuple[ClipLibrary, Humanoid, Reference, FitReport]:
    """Clips without noise on the skeleton of their body, the body, its reference, and what fitting did.

    table, widens: see `fit_humanoid`; by default a body is made, or is that of `body.mjcf`.
    """
    calm, noise = calm_library(as_library(clips))
    library, own = on_own_body(calm, body)
    humanoid, motions, report = fit_humanoid(library, body, rate_hz, table or own, widens, noise)
    return library, humanoid, Reference(humanoid, motions, rate_hz, library.names, report.cyclic), report


@dataclass(frozen=True, eq=False, repr=False)
class Imitation:
    """A library with a body, ready to be learned.

    Attributes:
        config: the recipe's settings; it must have `num_envs`, `seed`, `sim` and `ppo`, and
            `residual_std` where there is a residual force.
        recovery_clips: those of the library, where recovery is learned by them.
        props: what else stands in every world, such as a chair or a ball, or another character, which
            `papers.compliant.opponents` moves.
        links, touches, floor: of such worlds, see `Scene`; the character's bodies have their own names.
        physics: a model in place of the body's own on a floor, such as a heavier one; without props.
        goal: makes what so many worlds follow in place of the reference, by a seed.
    """

    library: ClipLibrary
    humanoid: Humanoid
    reference: Reference
    report: FitReport
    config: Any
    task: TaskConfig
    recovery_clips: RecoveryClips | None = None
    props: tuple[Prop | Character, ...] = ()
    physics: mujoco.MjModel | None = None
    links: tuple[Link, ...] = ()
    touches: tuple[Touch, ...] = ()
    floor: Floor = field(default_factory=Plane)
    goal: Callable[[int, int], Goal] | None = None

    def __repr__(self) -> str:
        clips, seconds = len(self.library), self.library.seconds
        body = f"{len(self.humanoid.bodies)} bodies, {len(self.humanoid.hinges)} hinges"
        return f"Imitation({type(self.config).__name__}, {clips} clips, {seconds:.1f} s, {body})"

    def env(
        self,
        num_envs: int | None = None,
        seed: int | None = None,
        auto_reset: bool = True,
        threads: int = 0,
        dumps: Path | None = None,
        help_scale: float | Tensor = 1.0,
        device: str = "cpu",
        guard: bool = True,
        backend: Backend | None = None,
    ) -> ImitationEnv:
        """An environment of this task; without `auto_reset` for evaluation from given frames.

        Args:
            threads: of the physics on the CPU.
            help_scale: what is left of the limits of the help, or of those of each of the task's groups
                `(G,)`, see `TaskConfig.help_by`.
            device: "cpu", or "cuda" for the physics on a GPU.
            guard: whether a simulation that goes bad in one world ends everything with an error;
                without, it is a failure like others.
            backend: in place of a fresh one, for worlds that are simulated in another way; `num_envs`,
                `device` and `threads` are then its own.
        """
        if backend is None:
            worlds = num_envs or self.config.num_envs
            backend = self._worlds(worlds, device, threads)
        seed = int(self.config.seed if seed is None else seed)
        task, substeps = replace(self.task, auto_reset=auto_reset), self.config.sim.substeps
        watch = NanGuard(backend, dumps, seed=seed) if guard else None
        goal = self.reference if self.goal is None else self.goal(backend.num_envs, seed)
        env = ImitationEnv(goal, backend, task, substeps, seed, guard=watch)
        if watch is not None:
            watch.where = env.where
        env.help.set(help_scale)
        return env

    @cached_property
    def model(self) -> mujoco.MjModel:
        """What is simulated of the body: alone on a floor, with the settings' physics."""
        return self.physics or alone(self.humanoid, self.config.sim)

    def _worlds(self, count: int, device: str, threads: int) -> Backend:
        """Fresh worlds with a character and the props."""
        if not (self.props or self.touches) and self.floor == Plane():
            return make_backend(self.model, count, device, threads=threads)
        things = (Character(self.humanoid), *self.props)
        scene = Scene(things, self.links, self.touches, self.floor, self.config.sim)
        return SceneSim(scene, count, device, threads).characters(things[0].name)

    def bare(self, rewards: bool = False, groups: bool = False) -> Imitation:
        """The same task with what a policy needs alone: no ends, no style, and without rewards but for
        `rewards`. groups: whether help keeps its groups; else all worlds have the same."""
        task = replace(self.task, dones=(), style=())
        task = task if rewards else replace(task, rewards=())
        return replace(self, task=task if groups else replace(task, help_by="all"))

    def ppo(self) -> PPOConfig:
        """The learner's settings, with one deviation of the action noise per action, and what smooth
        policies do not answer to."""
        ppo, extra = self.config.ppo, self.task.residual.dims if self.task.residual else 0
        if ppo.smooth_weight and ppo.smooth_over is None and self.task.velocities:
            env = self.env(1, threads=1)
            first, *_, last = (env.columns[name] for name in (self.task.velocities * 2))
            env.close()
            ppo = replace(ppo, smooth_over=(first.start, last.stop))
        if not isinstance(ppo.std, float | int):
            return ppo
        joints = (float(ppo.std),) * len(self.humanoid.hinges)
        return replace(ppo, std=joints + ((float(self.config.residual_std),) * extra if extra else ()))

    def check(self, num_envs: int, device: str = "cpu") -> None:
        """Whether the settings fit the task, before anything is written.

        A GPU's memory is checked where its worlds are made.

        Raises:
            PoiseError: `num_envs` characters are more than memory holds, or `ppo.smooth_over` names
                columns that the observations do not have.
        """
        many, over = num_envs > FEW and device == "cpu", self.config.ppo.smooth_over
        if not many and over is None:
            return
        few = 64 if many else 1
        env = self.env(few, threads=1)
        try:
            self.config.ppo.check_columns(env.num_obs)
            if not many:
                return
            fields = env.backend.state
            state = env.state()["sim"].nbytes + sum(fields[name].nbytes for name in fields.names)
            learner = learner_bytes(self.ppo().horizon, env.num_obs, env.num_actions)
        finally:
            env.close()
        # A step gathers the reference and evaluates the terms in a few copies of the observations.
        check_memory(num_envs, state // few + learner + 40 * env.num_obs, free_bytes())

    def trainer(
        self,
        threads: int = 0,
        dumps: Path | None = None,
        comm: Comm = ALONE,
        warm_start: WarmStart | None = None,
        ppo: PPOConfig | None = None,
        device: str = "cpu",
        style: Style | AmpConfig | None = None,
        env: ImitationEnv | None = None,
        lessons: tuple[Lessons, LessonConfig] | None = None,
        **metadata: Any,
    ) -> Trainer:
        """A PPO trainer on a fresh environment; `ppo` in place of this task's own settings.

        Args:
            threads: of the physics; 0 takes this process's share of the machine's cores.
            comm: the processes that train together; they share the config's environments out evenly.
            style: a motion prior's settings, for which the task must have `TaskConfig.style`; or a style
                of your own, with the `env` that it watches.
            env: in place of a fresh environment.
            lessons: a teacher and how is learned from it, see `plan.teacher`.
        """
        if env is None and style is not None and not isinstance(style, AmpConfig):
            raise PoiseError(
                "a style of your own watches an environment of its own",
                hint="Give that environment as env=, or give AmpConfig settings",
                code="settings-conflict",
            )
        rank = comm.rank
        if dumps is not None and rank:
            dumps = dumps / f"rank{rank}"
        if not threads and comm.local_size > 1:
            threads = max(1, machine_cores() // comm.local_size)
        if env is None:
            own = share_of(self.config.num_envs, comm)
            self.check(own, device)
            seed = rank_seed(self.config.seed, rank)
            env = self.env(own, seed, threads=threads, dumps=dumps, device=device)
        if isinstance(style, AmpConfig):
            style = Amp(env, env.demos(style.frames), style, self.config.seed, comm)
        # A GPU is fed by one thread.
        cores = 1 if env.device.type == "cuda" else threads or machine_cores()
        return Trainer(
            # An EnvStep has the fields of the learner's Step; neither room knows the other.
            cast(VecEnv, env),
            ppo or self.ppo(),
            self.config.seed,
            self.humanoid.identity,
            metadata=metadata,
            warm_start=warm_start,
            update_threads=cores,
            comm=comm,
            style=style,
            lessons=lessons,
        )

    def teacher(self, config: TeacherConfig, threads: int = 0) -> LookaheadTeacher:
        """A teacher of this task in worlds of its own, without help."""
        env = self.env(config.worlds, threads=threads, help_scale=0.0, guard=False)
        copies = self.bare(rewards=True).env(
            config.worlds * config.candidates, None, False, threads, help_scale=0.0, guard=False
        )
        return LookaheadTeacher(env, copies, config, int(self.config.seed))


#: Fewer characters than these fit anywhere, so that nothing is worked out for them.
FEW = 10_000
#: Share of the free memory that may be taken.
SHARE = 0.8


def free_bytes(root: Path = Path("/")) -> int | None:
    """Memory that this process may still take, None where the system does not say.

    The least of what the machine has available and what is left of the limit of a container.
    """
    found: list[int] = []
    try:
        lines = (root / "proc/meminfo").read_text().splitlines()
        found += [1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    except (OSError, ValueError, IndexError):
        pass
    group = root / "sys/fs/cgroup"
    try:
        limit = int((group / "memory.max").read_text())
        found.append(limit - int((group / "memory.current").read_text()))
    except (OSError, ValueError):
        # Without a limit the file says "max".
        pass
    return min(found) if found else None


def learner_bytes(horizon: int, num_obs: int, num_actions: int) -> int:
    """Bytes per character that one batch of experience takes while PPO learns from it."""
    # Observations as collected, their half-precision copy, actions and means, about a dozen numbers.
    return horizon * (6 * num_obs + 8 * num_actions + 48) + 16 * num_obs


def check_memory(num_envs: int, bytes_each: int, free: int | None) -> None:
    """Refuses more characters than fit, and says how many do.

    Raises:
        PoiseError: `num_envs` times `bytes_each` is more than `SHARE` of the `free` bytes.
    """
    if free is None or num_envs * bytes_each <= SHARE * free:
        return
    fit = max(1, int(SHARE * free / bytes_each))
    raise PoiseError(
        f"{num_envs:,} characters would take about {num_envs * bytes_each / 1e9:.1f} GB of memory, and "
        f"{free / 1e9:.1f} GB are free",
        hint=f"At most {fit:,} fit: use --envs {fit}",
        code="out-of-memory",
    )
