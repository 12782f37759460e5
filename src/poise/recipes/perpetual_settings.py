"""The settings of a run of the perpetual controller: one network for a whole library.

The switches of the paper's ablations, and training by stages, are `papers.perpetual.ablations`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from poise.errors import PoiseError
from poise.settings import (
    Checked,
    Count,
    Length,
    Limit,
    Migration,
    NotNegative,
    Range,
    Share,
    from_data,
    imported,
    part,
    validate,
)

if TYPE_CHECKING:
    from poise.body import BodyConfig
    from poise.learn import (
        AmpConfig,
        CloneConfig,
        ConvergenceConfig,
        LessonConfig,
        MiningConfig,
        PPOConfig,
    )
    from poise.plan import TeacherConfig
    from poise.recipes.body_shapes import BodyShapes
    from poise.sim import SimConfig

#: Deviations from the mean at which observations are clipped, so that lying is told from leaning.
WIDE = 30.0


#: As what a stage learns recovery, see `Recovery.phc`.
Recovers = Literal["primitive", "composer"]


@dataclass(frozen=True)
class RecoveryPlan(Checked):
    """How recovery is learned and judged.

    Attributes:
        share: of the whole training, what the recovery primitive has at least; of a single network it is
            taken from the part without recovery.
        falls: different fallen characters to begin from.
        primitive: which of them recovers: one of its "own", after those that track, or the "first",
            where that is a policy that goes on and can come back already.
        demonstrations: how many recovery motions are made of the library's own clips, where some get up
            and some walk, see `env.recovery.planner`; 0 learns to come back to a point, as the paper
            does.
        demonstration_share: of the episodes of a stage that tracks and recovers, how many are of them.
        quick: they get up and walk back a second sooner, see `env.recovery.get_up.QUICK`.
        trials, final_trials: of each kind of fail-state, at evaluations and with the finished policy.
        seconds: a character counts as back within each of these times; the last one decides.
        enough: share of all trials with which recovery is learned.
    """

    share: Annotated[float, Range(0, 1, above=True, below=True)] = 0.15
    primitive: Literal["own", "first"] = "own"
    falls: Count = 512
    demonstrations: Annotated[int, Range(0)] = 768
    demonstration_share: Annotated[float, Range(0, 1, above=True, below=True)] = 0.5
    quick: bool = False
    trials: Count = 32
    final_trials: Count = 100
    seconds: Annotated[tuple[float, ...], Length(1)] = (5.0, 10.0)
    enough: Annotated[float, Range(0, 1, above=True)] = 0.98


@dataclass(frozen=True)
class PushPlan(Checked):
    """Pushes in training, to which goals give way by Deep Compliant Control's law.

    Attributes:
        share: of the episodes that are pushed.
        newtons, every_s, lasts_s, impulse_ns: see `env.pushes.Pushes`.
        parts: kinds of bodies of which one is pushed.
        level: between which the level of compliance is drawn in each episode.
    """

    share: Annotated[float, Range(0, 1, above=True)] = 0.5
    newtons: tuple[float, float] = (20.0, 200.0)
    every_s: tuple[float, float] = (0.3, 2.0)
    lasts_s: tuple[float, float] = (0.1, 2.0)
    impulse_ns: Limit = 50.0
    parts: Annotated[tuple[str, ...], Length(1)] = ("pelvis", "spine", "head", "hand", "upper_arm")
    level: tuple[float, float] = (0.0, 0.2)


@dataclass(frozen=True)
class Perpetual:
    """Settings of one run.

    Attributes:
        ORDER: the place of the class that decides on the stages of a run.
        num_envs: environments that are simulated at once.
        seed: seed of everything random.
        goal: what is told of the next frame, "rotations" and places or "keypoints", which are places
            alone.
        shape: limb lengths and masses are observed, too.
        shapes: the bodies that are learned; more than one are observed in any case.
        heading: of which all that is observed is free: where the axis from hip to hip points on the
            ground ("hips"), which is singular only where that is vertical, or the root's "twist" about
            +Z, which turns at once where the body is upside down.
        window: control steps ahead of which the observation tells the reference's place, heading and
            `KEY_PARTS` besides the next one's whole pose, such as (2, 4, 8); a stream's last known frame
            is repeated.
        interpolate: targets of joints go evenly from the last to the new ones within a control step, see
            `control.PDTargets`.
        filter: share of the last action that actions keep, see `TaskConfig.filter`; the policy then
            observes the last action. 0 for none.
        action: "absolute" as in the paper, or "additive" to the reference's angles.
        faithful: where the paper and its code disagree about Eq. 2 and about recovery.
        energy: weight of the energy penalty, 0 for none; by default that of the code's composer, since
            with ten times as much falling early would pay, see `rewards.energy_term`.
        energy_form: of the "paper", squares of the hinges' power, or of the "code", its amount.
        root: weight of the reward for the root's place alone, see `rewards.root_position`.
        action_rate, torque_rate, acceleration, foot_slide: prices of changing actions and torques, of
            bodies accelerated otherwise than the reference's and of feet that slide, see `env.rewards`;
            with several bodies the soles are those of the first.
        noise: each clip is learned once more with so many times a video estimator's noise, such as
            (0.25, 0.5), of which the policy is told, and is judged by the clean clip, see `noisy`.
        pushes: a share of the episodes is pushed, and goals give way; the policy observes how, see
            `observations.yielding`. None: neither.
        style: the motion prior, None for none.
        termination: mean distance without the feet ("relaxed"), of "all" bodies, or any body's as in the
            "code".
        first: share of the episodes that begin on frame 0, as evaluations do.
        recovery: fallen and far characters get up and come back; `recovering` says how. Without, it is
            not learned.
        single_hidden: widths of the network.
        expert: training from nothing begins with a clone of a scripted expert, by `clone`, or by what
            suits the frames of the library where that is None, see `jobs.perpetual.stages.clone_for`.
        help_start: N and N m, what the residual force may give at first; 0 does without. In each stage
            it has ended at the share `help_share` of the stage's time, or before by success.
        help_by: success is that of each "bin" of a clip, a second or so, which keeps or loses help of
            its own, of each "clip", or of "all" episodes.
        adaptive_sampling: share of the episodes (but for those on frame 0) that begin up to two seconds
            before where others lately failed; the rest begin anywhere, as in the paper.
        adaptive_over: such places of the "clip" that was drawn, or of the whole "library", so that more
            is seen of long and hard clips.
        residual_std: deviation of the noise on the residual action, in units of the limits.
        evaluate_every: iterations between evaluations of the stage's clips; 0 has them take a tenth of
            the control steps.
        starts: frames of each clip from which evaluations begin, evenly spread; a clip succeeds where it
            does from all of them.
        cooling: share of a stage's longest time, at its end, in which the policy's step size falls
            evenly to a tenth; for steps of a fixed size, `ppo.kl_target=None`.
        mining, convergence: what fails is trained more; when a stage has learned what it can.
        teacher: lookahead that says what the policy should have done, None for none; PPO then trains
            the critic alone, unless `lessons.reinforce`.
        lessons: how is learned from it.
    """

    ORDER: ClassVar[str] = "poise.jobs.perpetual.stages:StageOrder"

    goal: Literal["rotations", "keypoints"] = "rotations"
    shape: bool = False
    shapes: BodyShapes = part("poise.recipes.body_shapes:BodyShapes")
    heading: Literal["hips", "twist"] = "hips"
    window: Annotated[tuple[int, ...], Range(2, unit="control steps")] = ()
    filter: Annotated[float, Range(0, 1, below=True)] = 0.0
    interpolate: bool = False
    action: Literal["absolute", "additive"] = "absolute"
    faithful: Literal["paper", "code"] = "code"
    energy: float = 0.00005
    energy_form: Literal["paper", "code"] = "code"
    root: NotNegative = 0.0
    action_rate: NotNegative = 0.0
    torque_rate: NotNegative = 0.0
    acceleration: NotNegative = 0.0
    foot_slide: NotNegative = 0.0
    noise: Annotated[tuple[float, ...], Range(0, 100, above=True, below=True)] = ()
    pushes: PushPlan | None = None
    style: AmpConfig | None = part("poise.learn:AmpConfig")
    termination: Literal["relaxed", "all", "code"] = "relaxed"
    first: float = 0.1
    recovery: bool = True
    recovering: RecoveryPlan = field(default_factory=RecoveryPlan)
    single_hidden: tuple[int, ...] = (1024, 512, 512)
    expert: bool = True
    help_start: float = 100.0
    help_share: Annotated[float, Range(0, 1, above=True)] = 0.8
    help_by: Literal["all", "clip", "bin"] = "bin"
    adaptive_sampling: Share = 0.5
    adaptive_over: Literal["clip", "library"] = "clip"
    residual_std: float = 0.3
    evaluate_every: int = 0
    starts: Count = 1
    cooling: Share = 0.0
    num_envs: int = 512
    horizon: int = 300
    seed: int = 0
    mining: MiningConfig = part("poise.learn:MiningConfig")
    convergence: ConvergenceConfig = part("poise.learn:ConvergenceConfig")
    clone: CloneConfig | None = part("poise.learn:CloneConfig", made=False)
    teacher: TeacherConfig | None = part("poise.plan:TeacherConfig", made=False)
    lessons: LessonConfig = part("poise.learn:LessonConfig")
    body: BodyConfig = part("poise.body:BodyConfig")
    sim: SimConfig = part("poise.sim:SimConfig")
    ppo: PPOConfig = part(
        "poise.learn:PPOConfig",
        std=0.02,
        policy_lr=2e-5,
        kl_target=0.05,
        lr_range=(5e-6, 3e-4),
        policy_hidden=(512, 256),
    )

    def __post_init__(self) -> None:
        validate(self)
        if self.goal == "keypoints" and self.action == "additive":
            what = "additive actions need the next frame's angles, of which keypoints tell nothing"
            raise PoiseError(
                what, hint="Take absolute actions, or rotations as the goal", code="settings-conflict"
            )
        if list(self.window) != sorted(set(self.window)):
            what = f"window must rise, got {self.window}"
            raise PoiseError(what, "Perpetual", "The next step is told in any case", code="not-rising")
        if len(set(self.noise)) < len(self.noise):
            raise PoiseError(
                f"noise needs different strengths, got {self.noise}", "Perpetual", code="out-of-range"
            )
        if self.noise and self.shapes.several:
            raise PoiseError(
                "noise is learned on one body, and there are several shapes",
                "Perpetual",
                code="settings-conflict",
            )
        if self.cooling and self.ppo.kl_target is not None:
            what = "cooling is for steps of a fixed size, and kl_target adapts them"
            raise PoiseError(
                what, "Perpetual", "Set kl_target=None, or leave cooling out", code="settings-conflict"
            )
        if self.ppo.learn_std:
            raise PoiseError(
                "primitives keep their action noise",
                "Perpetual",
                "Set learn_std=False",
                code="settings-conflict",
            )

    @classmethod
    def additive(cls, **changes: Any) -> Self:
        """Settings for hours on a CPU: actions add to the reference's angles, with noise in radians
        that no joint's range scales; there is no motion prior; the discount looks further ahead; and a
        stage has more evaluations before it counts as learned. Many worlds make large batches: what one
        hard motion bin of many tells is lost in small ones, with steps large enough to learn it.
        Adaptive sampling over the whole library draws half of the starts; the others are anywhere.
        Observations are clipped far out, since lying on the floor is far from the mean of walks."""
        from poise.learn import ConvergenceConfig, MiningConfig

        ppo = replace(
            cls().ppo, std=0.055, policy_lr=1e-4, gamma=0.97, horizon=32, minibatch=8192, epochs=3,
            obs_clip=WIDE,
        )  # fmt: skip
        own: dict[str, Any] = {
            "ppo": ppo, "convergence": ConvergenceConfig(patience=12), "style": None, "num_envs": 2048,
            "adaptive_over": "library", "mining": MiningConfig(rule="uniform"),
        }  # fmt: skip
        return cls(action="additive", **(own | changes))

    def taught(self) -> Self:
        """The same settings with a teacher that looks ahead. What is observed and done suits it: the
        heading of the hips, later frames, a filter of actions. Most time is the teacher's, and few
        worlds train the critic."""
        from poise.plan import TeacherConfig

        recovering = replace(self.recovering, demonstration_share=0.15)
        return replace(
            self, heading="hips", window=(2, 4, 8), filter=0.5, root=0.2, num_envs=128,
            recovering=recovering, teacher=TeacherConfig(),
        )  # fmt: skip

    @property
    def widens(self) -> bool:
        """Whether ranges of hinges may grow after training: absolute targets are shares of them."""
        return self.action == "additive"

    @property
    def method(self) -> str:
        """What a score card calls it."""
        return "perpetual-single"

    @property
    def primitives(self) -> bool:
        """Whether the policy is made of primitives and a composer."""
        return False

    @property
    def help_limit(self) -> float:
        """N and N m that are left at the end."""
        return 0.0


#: What earlier versions called the settings, and what their runs did that name none.
MIGRATION = Migration(
    keys={
        "hard_starts": "adaptive_sampling", "hard_over": "adaptive_over", "paths": "trajopt",
        "trajopt.stretch_s": "trajopt.segment_s",
        "trajopt.plan.frequency": "trajopt.plan.spring.frequency",
        "trajopt.plan.damping": "trajopt.plan.spring.damping",
        "trajopt.plan.turn_frequency": "trajopt.plan.spring.turn_frequency",
        "trajopt.plan.turn_damping": "trajopt.plan.spring.turn_damping",
        "recovering.ways": "recovering.demonstrations",
        "recovering.way_share": "recovering.demonstration_share",
    },
    values={"help_by": {"moment": "bin"}},
    absent={
        "recovery": False, "help_by": "all", "adaptive_sampling": 0.0, "adaptive_over": "clip",
        "heading": "twist",
    },
)  # fmt: skip


#: Settings that a run by stages has besides, by which it is known, and the class of its settings.
STAGED = frozenset(
    (
        *("multiplicative", "progressive", "single", "max_primitives", "start", "lateral", "combine"),
        *("weights", "composer_hidden", "composer_clone", "trajopt", "shares"),
    )
)
BY_STAGES = "poise.papers.perpetual.ablations:StagedPerpetual"


def config_of(
    data: Mapping[str, Any], where: Path | str | None = None, kind: type[Perpetual] | None = None
) -> Perpetual:
    """The settings that a run or a policy file holds as JSON data, also of earlier versions.

    kind: the class of the settings; by default that of `BY_STAGES` where they are not of one network.
    """
    data = MIGRATION(data)
    staged = STAGED & data.keys()
    if kind is None:
        kind = imported(BY_STAGES) if staged and not data.get("single", False) else Perpetual
    assert kind is not None
    if kind is Perpetual:
        data = {name: value for name, value in data.items() if name not in STAGED}
    elif not staged:
        data["single"] = True
    return from_data(kind, data, where)
