"""Deep Compliant Control's imitation controller: state, features, rewards (Secs. 4.1, 4.2).

| paper                                      | here                                     |
|--------------------------------------------|------------------------------------------|
| Sec. 4.1 Eq. 11 r_imit = r_q r_p           | `AmpConfig.product`, `root_place`        |
| Eqs. 12, 13 the discriminator's r_q        | `AmpConfig.compliant`, `posture`         |
| Eq. 14 r_p                                 | `root_place`                             |
| Sec. 4.2 s = s(q (-) u), two poses, u      | `two_poses`, `turns`, `displacement`     |
| Sec. 5.1 network, PPO, noise of 6 degrees  | `CompliantImitation.paper`               |
| Sec. 3, 5.2 compliance                     | `TaskConfig.compliance`                  |
| Sec. 5.3 transitions among several motions | `chained`                                |

Policy and discriminator both see q (-) u. Terms ask for `frame.shifted`; in frames of clips, which know
of no displacement, that is None, and the clip's own pose is taken.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from torch import Tensor

from poise.body import BodyConfig, Humanoid
from poise.control import Compliance, PDTargets
from poise.env import DoneTerm, ObsTerm, Reference, RewardTerm, TaskConfig
from poise.env import observations as obs
from poise.env import rewards as reward
from poise.env.frame import Frame
from poise.env.pushes import Pushes
from poise.env.rewards import pose
from poise.env.style import ClipWindows
from poise.errors import PoiseError
from poise.learn import Amp, AmpConfig, PPOConfig, Trainer
from poise.motion.rotations import (
    heading_angle,
    into_heading,
    quat_between,
    quat_to_sixd,
    slerp,
    turned,
)
from poise.papers.compliant.opponents import Shifted
from poise.recipes.imitation import Clips, Imitation, fitted
from poise.settings import Migration, Range, from_data, validate
from poise.sim import SimConfig


def two_poses(frame: Frame) -> Tensor:
    """All bodies now and one control step earlier, m, from the root's place on the floor in the present
    heading frame `(N, 6 B)`, without what displaces the character."""
    own = frame.shifted
    origin = own.pos[:, :1] * own.pos.new_tensor((1.0, 1.0, 0.0))
    return into_heading(own.heading, torch.cat((own.pos, own.before), 1) - origin).flatten(1)


def turns(frame: Frame) -> Tensor:
    """The orientation of every body in the heading frame, two columns of its matrix each `(N, 6 B)`."""
    own = frame.shifted
    local = quat_between(own.heading.unsqueeze(1).expand_as(own.quat), own.quat)
    return quat_to_sixd(local).flatten(1)


def displacement(frame: Frame, source: str = "compliance/u") -> Tensor:
    """u `(N, 6 + n)`, by how much the goal is displaced, m and rad. source: "shifted/u" is known where
    nothing gives way, too."""
    return frame.source(source).float()


def posture(frame: Frame) -> Tensor:
    """What the discriminator, which is shown pairs, sees of a frame: all bodies from the root's place on
    the floor in the heading frame, m, the turns of the hinged bodies 6D, and the root's velocity, m/s,
    and speed of turning, rad/s, in that frame `(N, 3 B + 6 J + 6)`.

    Poses are without what displaces the character. The root's velocity stands for the earlier pose of
    Sec. 4.2, which a frame of a clip does not tell; it is the character's own.
    """
    own, sim = frame.shifted or frame.sim, frame.sim
    origin = own.pos[:, :1] * own.pos.new_tensor((1.0, 1.0, 0.0))
    places = into_heading(own.heading, own.pos - origin).flatten(1)
    moves = torch.stack((sim.linvel[:, 0], sim.angvel[:, 0]), 1)
    moves = into_heading(sim.heading, moves).flatten(1)
    return torch.cat((places, quat_to_sixd(own.local).flatten(1), moves), 1)


def root_place(
    frame: Frame,
    weights: tuple[float, float] = (0.7, 0.3),
    alphas: tuple[float, float] = (0.5, 1.0),
) -> Tensor:
    """r_p of Eq. 14: w_p exp(-s_p |p - u_p|^2) + w_v exp(-s_v |v - u_p'|^2), of the root against the
    displaced reference's, m and m/s in the world."""
    apart = (frame.sim.pos[:, 0] - frame.ref.pos[:, 0]).square().sum(-1)
    faster = (frame.sim.qvel[:, :3] - frame.ref.qvel[:, :3]).square().sum(-1)
    (w_p, w_v), (s_p, s_v) = weights, alphas
    return w_p * torch.exp(-s_p * apart) + w_v * torch.exp(-s_v * faster)


def posed_place(frame: Frame, alpha: float = 2.0) -> Tensor:
    """r_q r_p with a measured r_q in place of the discriminator's: `rewards.pose`, which follows the
    displaced reference joint by joint."""
    return pose(frame, alpha) * root_place(frame)


#: Three layers of 256 and the discount of Sec. 5.1; the rest is for minutes on a CPU.
_PPO = PPOConfig(
    policy_hidden=(256, 256, 256), value_hidden=(256, 256, 256), gamma=0.95, horizon=32, minibatch=1024,
    epochs=5, std=0.055, policy_lr=3e-4,
)  # fmt: skip


@dataclass(frozen=True)
class CompliantImitation:
    """Settings of one run.

    Attributes:
        style: the discriminator that gives r_q; None takes the distance to the displaced reference's
            pose.
        action: absolute targets, the paper's, or targets added to the displaced reference's angles. With
            these the policy also sees the reference's next angles.
        level: of compliance, alpha; None for a character that does not give way.
        newtons: between which pushes at the hands are drawn; None for none.
        chains: goals that go from clip to clip, of which so many are learned beside several clips; the
            discriminator knows the clips alone. See `chained`.
    """

    style: AmpConfig | None = field(default_factory=AmpConfig.compliant)
    action: Literal["absolute", "additive"] = "additive"
    level: float | None = 0.16
    newtons: tuple[float, float] | None = (10.0, 60.0)
    chains: Annotated[int, Range(0)] = 8
    num_envs: int = 256
    horizon: int = 300
    seed: int = 0
    body: BodyConfig = BodyConfig()
    sim: SimConfig = SimConfig()
    ppo: PPOConfig = _PPO

    def __post_init__(self) -> None:
        validate(self)
        if self.style is not None and not self.style.product:
            what = "r_imit is the product of r_q and r_p (Eq. 11)"
            raise PoiseError(
                what,
                "CompliantImitation",
                "Set AmpConfig.product, as compliant() does",
                code="settings-conflict",
            )

    @property
    def method(self) -> str:
        """Its name on a score card."""
        return str(RECIPE["name"])

    @classmethod
    def paper(cls, few: bool = True, **changes: Any) -> CompliantImitation:
        """All that the paper states: 600 Hz, absolute targets, updates of 2,048 control steps in
        minibatches of 128 at a rate of 1e-5, noise of 6 degrees, kv = 2 sqrt(kp) at kp = 400; for 6 to
        24 hours.

        few: whether the clips are few, see `AmpConfig.compliant`. changes: settings that differ.

        Not stated, and ours: control steps per second (30), how many worlds share an update, passes over
        it, limits of torques. Not expressed: one kp of 300 to 500 for all joints; here gains follow the
        body's size.
        """
        ppo = replace(
            _PPO, horizon=64, minibatch=128, epochs=PPOConfig().epochs, policy_lr=1e-5, value_lr=1e-5,
            std=math.radians(6.0),
        )  # fmt: skip
        stated: dict[str, Any] = {
            "style": AmpConfig.compliant(few), "action": "absolute", "num_envs": 32,
            "body": BodyConfig(damping=0.1), "sim": SimConfig(rate_hz=600.0), "ppo": ppo,
        }  # fmt: skip
        return cls(**(stated | changes))


def observations(config: CompliantImitation) -> tuple[ObsTerm, ...]:
    """(s_dyn, u), and where the displaced reference's root is."""
    u = ObsTerm("displacement", displacement, {"source": "shifted/u"})
    own = (two_poses, turns)
    goal = (obs.target_root, *((obs.target_joints,) if config.action == "additive" else ()))
    before, after = (tuple(ObsTerm(t.__name__, t) for t in terms) for terms in (own, goal))
    return (*before, u, *after)


def task(config: CompliantImitation, humanoid: Humanoid) -> TaskConfig:
    """The controller's task as terms."""
    events: tuple[Any, ...] = (Shifted,)
    if config.newtons is not None:
        hands = humanoid.rows_of("hand")
        if not hands:
            raise PoiseError(
                "the body has no hands to push", hint="Set newtons=None", code="body-part-missing"
            )
        hz = config.sim.control_hz
        events += (Pushes(config.newtons, (0.5, 1.5), 0.3, hands, hz, config.seed),)
    paid = root_place if config.style else posed_place
    root = torch.tensor([0])
    return TaskConfig(
        obs=observations(config),
        rewards=(RewardTerm(paid.__name__, paid, 1.0),),
        dones=(
            DoneTerm("root_below", reward.root_below, {"margin": 0.35}),
            DoneTerm("root_far", reward.bodies_too_far, {"limit": 1.0, "bodies": root}),
        ),
        pd=PDTargets(config.action),
        horizon=config.horizon,
        style=(ObsTerm("posture", posture),) if config.style else (),
        compliance=None if config.level is None else Compliance(config.level),
        events=events,
    )


#: s: how long a piece of a chain is, of a clip that is as long; s in which a pose passes into the next.
PIECE_S, PASSES_S = (1.5, 3.0), 0.3


def chained(reference: Reference, count: int, seconds: float, seed: int = 0) -> Reference:
    """Goals that last so many `seconds` and go from clip to clip: pieces of the clips in a drawn order,
    each begun where the last one ended and as it was heading.

    In the first `PASSES_S` of a piece the last pose passes into it, joint by joint, which no clip shows:
    a controller that sees the root alone, as one with absolute targets does, has to find its own steps.
    """
    rng, rate = np.random.default_rng(seed), reference.rate_hz
    lengths = [int(n) for n in reference.length]
    clips = [q.numpy() for q in torch.split(reference.qpos, lengths)]
    frames = max(3, round(seconds * rate) + 1)
    made = [_chain(clips, frames, rate, rng) for _ in range(count)]
    return Reference(reference.humanoid, made, rate, [f"chain-{i + 1}" for i in range(count)])


def _chain(clips: list[np.ndarray], frames: int, rate: float, rng: np.random.Generator) -> np.ndarray:
    out, k = np.empty((0, clips[0].shape[1])), -1
    while len(out) < frames:
        others = [i for i in range(len(clips)) if i != k] or [k]
        k = others[int(rng.integers(len(others)))]
        long = min(len(clips[k]), max(3, round(rng.uniform(*PIECE_S) * rate)))
        first = int(rng.integers(len(clips[k]) - long + 1))
        piece = clips[k][first : first + long].copy()
        if len(out):
            last, goes = out[-1], out[-1, :2] - out[-2, :2]
            angle = heading_angle(last[3:7]) - heading_angle(piece[0, 3:7])
            piece = turned(piece, angle, piece[0, :2], last[:2] + goes)
            n = min(len(piece), max(1, round(PASSES_S * rate)))
            share = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, n + 1) / (n + 1))[:, None]
            piece[:n, 3:7] = slerp(np.repeat(last[None, 3:7], n, 0), piece[:n, 3:7], share[:, 0])
            for part in (slice(2, 3), slice(7, None)):
                piece[:n, part] = last[part] + share * (piece[:n, part] - last[part])
        out = np.concatenate((out, piece))
    return out[:frames]


def build(clips: Clips, config: CompliantImitation | None = None) -> Imitation:
    """Body, reference and task of clips in any order; `trainer` trains it."""
    config = config or CompliantImitation()
    library, humanoid, reference, report = fitted(clips, config.body, config.sim.control_hz)
    if config.chains and len(library) > 1:
        seconds = config.horizon / config.sim.control_hz
        reference = reference.joined(chained(reference, config.chains, seconds, config.seed))
    return Imitation(library, humanoid, reference, report, config, task(config, humanoid))


def trainer(made: Imitation, threads: int = 0) -> Trainer:
    """Trains what `build` made, by the discriminator of its settings, which is shown the clips and no
    chains."""
    style: AmpConfig | None = made.config.style
    made.check(made.config.num_envs)
    env = made.env(threads=threads)
    if style is None:
        return made.trainer(threads, env=env)
    odds = (made.reference.length.cpu() - 1).double()
    odds[len(made.library) :] = 0.0
    demos = ClipWindows(env.clip_features, style.frames, lambda: odds)
    return made.trainer(threads, env=env, style=Amp(env, demos, style, made.config.seed))


#: The settings of earlier versions' runs, which do not name them.
_MIGRATION = Migration(absent={"chains": 0})


def config_of(data: Mapping[str, Any], where: Path | str | None = None) -> CompliantImitation:
    """The settings that a run holds as JSON data."""
    return from_data(CompliantImitation, _MIGRATION(data), where)


#: See `results/papers.csv`.
RECIPE: dict[str, Any] = {"name": "compliant-imitation", "config": CompliantImitation, "build": build}
