"""Skeleton2Humanoid (Li et al., ACM MM 2022): three stages, of which each can be left out.

Stage I makes skeleton motion between keyframes and adapts to what it is asked, stage II brings the
places of its joints onto a humanoid, stage III lets a policy imitate it with a residual force that
becomes less while it learns. `pipeline` does I and II and gives the task of III; the floor fit between
II and III is ours.

| paper                                        | here                                               |
|----------------------------------------------|----------------------------------------------------|
| Sec. 3.1 in-betweening (Harvey et al.)       | `jobs.inbetween`, `rtn`, `learn.between`           |
| Sec. 3.2 test-time adaptation, Eqs. 1 to 4   | `learn.inbetween_model`                            |
| Sec. 3.3, App. A analytic IK                 | `kinematics.clip_ik` by `posed`, in `build`        |
| Sec. 3.4.1 state with the next two frames    | `env.observations`, `observation="next two"`       |
| Sec. 3.4.1 action (u_t, eta_t), Eq. 8        | `control.PDTargets`, `control.ImplicitResidual`    |
| Sec. 3.4.2 curriculum, Eq. 9                 | `control.LinearHelp`                               |
| App. B an episode ends 0.5 m too low         | `env.rewards.root_below`                           |
| baseline UHC (Luo et al. 2021), in-house     | `uhc`                                              |

A policy of stage III is trained on the very motions that it corrects, one policy for each length of
transition: it is an optimiser of a set of motions. What needs no training is the universal policy with
lookahead, without any help: `jobs.complete`. There the body takes the network's own rotations, and
motion that comes in as places alone is posed by `formats.point_fit`: it lies nearer to the places than
stage II does and is smoother, see `results/papers.csv`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from poise.body import BodyConfig, generate_table
from poise.env import Reference
from poise.errors import PoiseError
from poise.jobs.inbetween.fill import inbetween
from poise.kinematics import clip_ik, clip_to_qpos, ik_body, qpos_to_clip
from poise.kinematics.place import on_own_body
from poise.learn import PPOConfig
from poise.motion import Clip, ClipLibrary, resample
from poise.recipes.imitation import Clips, Imitation, as_library
from poise.recipes.residual_force import build as imitation_of
from poise.recipes.residual_force_settings import ResidualForce
from poise.synthesis.filler import EACH_GAP

#: Eq. 9: S_init in N and N m, what is left of it at i_end, and both iterations of 1,500.
INITIAL, LEFT, FALLS, ITERATIONS = 220.0, 100.0, (100, 1300), 1500
#: Samples of an iteration in the paper.
BATCH = 50_000
#: The rows of Table 4, and the curriculum that goes on to no force at all.
Variant = Literal["uhc", "one frame", "no curriculum", "full", "full to zero"]


@dataclass(frozen=True)
class Budget:
    """How long a policy is trained.

    Attributes:
        num_envs: characters side by side.
        horizon: control steps of each in an iteration.
        iterations: of PPO; the curriculum's iterations are the same shares of them as in the paper.
    """

    num_envs: int = 512
    horizon: int = 16
    iterations: int = 240

    @classmethod
    def paper(cls) -> Budget:
        """1,500 iterations of about 50,000 samples."""
        return cls(num_envs=1024, horizon=BATCH // 1024 + 1, iterations=ITERATIONS)

    @property
    def falls(self) -> tuple[int, int]:
        """Control steps of each character between which the force becomes less."""
        first, last = (round(i / ITERATIONS * self.iterations) * self.horizon for i in FALLS)
        return first, max(first + 1, last)


def settings(variant: Variant = "full", budget: Budget | None = None, **changes: Any) -> ResidualForce:
    """The settings of stage III or of its baseline; `changes` are settings that differ.

    UHC differs from the whole by what the paper's Table 4 takes away: the second of the next frames
    and the curriculum. All have the same force, action, reward, network and number of samples.

    Not stated in the paper, and ours: which of Residual Force Control's rewards (that in world
    coordinates), whether forces act on all joints or on the root (on the root, as UHC's code has it),
    signed forces where it prints k_r in [0, 1], and the learner's settings. `expert=False` begins from
    nothing, as the paper does; by default all begin from the same cloned expert (`jobs.warm_start`).
    """
    if variant not in ("uhc", "one frame", "no curriculum", "full", "full to zero"):
        raise PoiseError(f"there is no variant '{variant}'", code="unknown-choice")
    budget = budget or Budget()
    constant = variant in ("uhc", "no curriculum")
    stated: dict[str, Any] = {
        "observation": "next frame" if variant in ("uhc", "one frame") else "next two",
        "help_start": None if constant else INITIAL,
        "help_limit": INITIAL if constant else 0.0 if variant == "full to zero" else LEFT,
        "help_schedule": "linear",
        "help_steps": budget.falls,
        "done": "below",
        "action": "additive",
        "reward": "world",
        "completion_bonus": False,
        "num_envs": budget.num_envs,
        "ppo": learner(budget),
    }
    return replace(ResidualForce(), **(stated | changes))


def learner(budget: Budget) -> PPOConfig:
    """PPO with the paper's network, 1024-512-256."""
    hidden = (1024, 512, 256)
    ppo = ResidualForce().ppo
    return replace(ppo, policy_hidden=hidden, value_hidden=hidden, horizon=budget.horizon)


def posed(clips: Clips, body: BodyConfig | None = None) -> ClipLibrary:
    """Stage II: the same motions with the rotations that the analytic inverse kinematics make of the
    places of their joints alone.

    Joints without a body of their own (fingers) keep their rotations; hinges that places do not show
    (wrists, the head where no joint lies above it) are at rest, as in the paper.

    Raises:
        PoiseError: a skeleton without two arms, two legs and a spine, or places that are not finite.
    """
    body = body or ResidualForce().body
    library, table = on_own_body(as_library(clips), body)
    first = library.clips[0].skeleton
    table = table or generate_table(first, body, library.clips)
    bones = ik_body(table, first)
    made = (qpos_to_clip(clip_ik(c, bones), table, c.skeleton, c.fps, c, c.name) for c in library)
    kept = zip(library.clips, made, strict=True)
    return replace(library, clips=tuple(c.replaced(root_pos=m.root_pos, rot=m.rot) for c, m in kept))


def as_came(imitation: Imitation) -> Imitation:
    """The same task with the motions as they came: no joint slowed down, and not set on the floor."""
    ref, humanoid = imitation.reference, imitation.humanoid
    motions = [clip_to_qpos(resample(c, ref.rate_hz), humanoid.table) for c in imitation.library]
    reference = Reference(humanoid, motions, ref.rate_hz, ref.names, ref.cyclic.tolist())
    return replace(imitation, reference=reference)


def build(
    clips: Clips, config: ResidualForce | None = None, *, analytic: bool = True, floor: bool = True
) -> Imitation:
    """Stage II, and the task of stage III: body and reference of the converted motions; train with
    `.trainer()`, or as any run of residual forces (`jobs.runs`), which begins with `posed` clips.

    Args:
        analytic: the angles are those of `posed`; False takes the clips' own.
        floor: the motions are set on the floor, and joints faster than people's slowed down; the paper
            does neither.
    """
    config = config or settings()
    made = imitation_of(posed(clips, config.body) if analytic else clips, config)
    return made if floor else as_came(made)


def pipeline(
    clips: Sequence[Clip],
    keyframes: Sequence[int],
    config: ResidualForce | None = None,
    *,
    adapt: int = EACH_GAP.iterations,
    analytic: bool = True,
    floor: bool = True,
) -> Imitation:
    """Stage I of what lies between keyframes of clips, stage II, and the task of stage III.

    Args:
        keyframes: the same frames of each clip. adapt: iterations of test-time adaptation, 0 without.
        analytic, floor: see `build`.

    Raises:
        PoiseError: see `inbetween` and `posed`.
    """
    filled = [inbetween(c, keyframes, adapt=adapt, foot_lock=False).clip for c in clips]
    return build(ClipLibrary.of(filled), config, analytic=analytic, floor=floor)


#: See `results/papers.csv`.
RECIPE: dict[str, Any] = {
    "name": "skeleton-to-humanoid",
    "config": ResidualForce,
    "build": build,
    "expected": {},
}
