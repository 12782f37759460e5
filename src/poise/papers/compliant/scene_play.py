"""Scenes played by a trained policy: with compliance and without, side by side in figures.

played = play(Hands(), clip=read_clip("walk.bvh"), given=Stiffness(200.0))
played.figures["force_mean_n"], played.write(Path("out"))
"""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from poise.control import Compliance, Stiffness
from poise.env import Acts, ImitationEnv
from poise.env.recovery.get_up import RecoveryClips
from poise.env.recovery.recovering import Recovering
from poise.errors import PoiseError
from poise.formats import write_clip
from poise.formats.text import write_whole
from poise.jobs.deliver import Evaluation, make_report, simulated_clip
from poise.jobs.open import open_run
from poise.jobs.result import RULE
from poise.jobs.runs import scored
from poise.jobs.track.controllers import look_ahead
from poise.jobs.tracker import Tracker
from poise.motion import Clip
from poise.papers.compliant.motions import motion_of
from poise.papers.compliant.opponents import Opponent, opposing, partner_stage, rival_stage
from poise.papers.compliant.scene_training import LearnedOnTop, Topped, at_rate, seen, set_up
from poise.papers.compliant.scenes import SCENES, Chicken, HandInHand, PlayScene, SceneSetup
from poise.papers.compliant.scenes.stage import feels
from poise.papers.compliant.watch import Watch, meter_of
from poise.plan import LookaheadConfig
from poise.recipes.imitation import Imitation
from poise.score import run_episodes, write_score
from poise.score.report import Mover, write_report
from poise.score.rollouts import RolloutSet
from poise.sim import Character

#: m/s^2; greatest force, in weights of a character, about which nothing is said.
G, MOST_WEIGHTS = 9.81, 20.0
#: Figures of which episodes are counted.
COUNTS = frozenset(("lost", "opened", "touched", "rival_fell", "one_leg", "falls", "up_again"))
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


@dataclass(frozen=True, eq=False)
class Played:
    """What came of a scene.

    Attributes:
        scene: its name.
        words: what the figures are, by their keys.
        imitation: the task of the compliant character.
        evaluation: its episodes and score.
        episodes, stiff_episodes: `(E,)` by the keys of `words`, of the compliant character and of its
            twin that does not give way; NaN where an episode has none.
        arrows: of each frame of the first episode `(K, 6)`: points, m, and forces felt there, N.
        movers: what moves in its world.
    """

    scene: str
    words: Mapping[str, str]
    imitation: Imitation
    evaluation: Evaluation
    episodes: Mapping[str, np.ndarray]
    stiff_episodes: Mapping[str, np.ndarray]
    arrows: tuple[np.ndarray, ...]
    movers: tuple[Mover, ...]

    @property
    def count(self) -> int:
        """Episodes of each."""
        return len(self.episodes["lost"])

    @property
    def figures(self) -> Mapping[str, float]:
        """Means over the episodes of the compliant character; of `COUNTS` how many."""
        return summed(self.episodes)

    @property
    def stiff(self) -> Mapping[str, float]:
        """The same of its twin."""
        return summed(self.stiff_episodes)

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
        episodes = "1 episode" if self.count == 1 else f"{self.count} episodes"
        if "stays_s" in self.figures:
            # The forces are fictional there, so that their size tells nothing.
            c, d = (f"{f['stays_s']:.1f} s" for f in (self.figures, self.stiff))
            told = f"{episodes}: the ball stays for {c}, {d} without"
            return f"{told}; {lost} were lost, {others} without."
        return (
            f"{episodes}: the interaction force is {a:.1f} N on average, {less} than without "
            f"compliance ({b:.1f} N); {lost} were lost, {others} without."
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence where a force is greater than people bear."""
        most = max(float(np.nanmax(e["force_peak_n"])) for e in (self.episodes, self.stiff_episodes))
        weight = self.imitation.humanoid.mass * G
        if most <= MOST_WEIGHTS * weight:
            return ()
        return (
            f"The greatest interaction force is {most:,.0f} N, {most / weight:.0f} times the "
            "character's weight, which nobody bears: limbs are wedged, or a link is torn at.",
        )

    def write(self, out: Path) -> dict[str, Path]:
        """`simulated.bvh`, `score.json`, `figures.json` and `report.html` in a folder."""
        out.mkdir(parents=True, exist_ok=True)
        paths = {k: out / n for k, n in (("simulated", "simulated.bvh"), ("figures", "figures.json"))}
        write_clip(self.clip, paths["simulated"])
        told = {"scene": self.scene, "episodes": self.count, "compliant": dict(self.figures),
                "without": dict(self.stiff)}  # fmt: skip
        write_whole(paths["figures"], json.dumps(told, indent=1) + "\n")
        paths["score"] = write_score(self.evaluation.card, out / "score.json")
        report = make_report(self.imitation, self.evaluation, {})
        frames = len(report.reference.pos)
        report = replace(
            report, title=_title(self.scene, report.title), movers=self.movers,
            pushes=self.arrows if len(self.arrows) == frames else (),
            notes=(self.sentence(), *self.notes, *report.notes),
        )  # fmt: skip
        paths["report"] = out / "report.html"
        write_report(report, paths["report"])
        return paths


class Looked(NamedTuple):
    """Episodes of one character in a scene, and what was seen of them."""

    task: Imitation
    rollouts: RolloutSet
    watch: Watch
    evaluation: Evaluation


def played(scene: PlayScene, one: Looked, stiff: Looked, name: str = "") -> Played:
    """Episodes of a character that gives way beside those of its twin that does not.

    name: of the scene, by default that of its class.
    """
    called = name or next(k for k, kind in SCENES.items() if kind is type(scene))
    return Played(
        called,
        {**WORDS, **one.watch.words},
        one.task,
        one.evaluation,
        {k: v.numpy() for k, v in one.watch.figures(one.rollouts, one.task).items()},
        {k: v.numpy() for k, v in stiff.watch.figures(stiff.rollouts, one.task).items()},
        tuple(one.watch.arrows),
        one.watch.movers(),
    )


def summed(episodes: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Means over episodes, of `COUNTS` how many; 0 where no episode has a figure."""
    out = dict[str, float]()
    for name, values in episodes.items():
        known = values[~np.isnan(values)]
        value = known.sum() if name in COUNTS else known.mean() if len(known) else 0.0
        out[name] = round(float(value), 4)
    return out


def play(
    scene: PlayScene,
    policy: Tracker | str | Path | None = None,
    clip: Clip | None = None,
    given: Compliance | Stiffness | None = None,
    count: int = 16,
    seconds: float = 8.0,
    threads: int = 0,
    name: str = "",
    learned: LearnedOnTop | None = None,
    controller: Literal["policy", "lookahead"] = "policy",
    lookahead: LookaheadConfig | None = None,
    recover: bool = False,
    rival: LearnedOnTop | None = None,
) -> Played:
    """A scene with compliance and without, from the same starts, which are off by `scene.starts`.

    Args:
        policy: see `poise.track`.
        clip: what the character does; None stands at ease for so many `seconds`.
        given: how it gives way; None is what suits the scene, Compliance() for most.
        count: of episodes, side by side.
        name: of the scene, by default that of its class.
        learned: what was learned on top of the policy, for the character that gives way; it gives way as
            it has learned to, or by the level that is given where it has learned several, and then acts
            in the twin, too.
        controller: the policy alone, or with lookahead, which simulates the scene with all that is going
            to happen in it; not with what was learned on top, nor for two people.
        lookahead: how it looks ahead.
        recover: get up after a fall and go on with the motion, which waits so long; an opponent or
            partner stays down.
        rival: what was learned on top for the opponent or partner; None is what the player has learned.

    Raises:
        PoiseError: the body cannot do the scene, the clip cannot be read, or the policy has not learned
            to get up.
    """
    two = getattr(scene, "against", "") == "rival" or getattr(scene, "partner", "") == "person"
    if controller == "lookahead" and (learned or two):
        what = "for two people" if learned is None else "with what was learned on top"
        raise PoiseError(
            f"lookahead does not act {what}",
            name or "play",
            "Take controller='policy'",
            code="settings-conflict",
        )
    tracker = policy if isinstance(policy, Tracker) else open_run(policy).tracker
    if recover and tracker.recovery_clips is None:
        raise PoiseError(
            "the policy has not learned to get up",
            name or "play",
            "Leave recover out, or train one on a library with a clip that gets up",
            code="recovery-not-learned",
        )
    tracker = at_rate(scene, tracker)
    if clip is not None and motion_of(scene, tracker, seconds) is not None:
        raise PoiseError(
            "the scene has a motion of its own",
            name or "play",
            "Leave the clip out",
            code="settings-conflict",
        )
    task, stage = set_up(scene, tracker, seconds, clip)
    opponent: Imitation | None = None
    if isinstance(scene, Chicken) and scene.against == "rival":
        stage, opponent = rival_stage(scene, tracker, stage)
    elif isinstance(scene, HandInHand) and scene.partner == "person":
        stage, opponent = partner_stage(scene, tracker, task, stage)
    task = replace(task, props=stage.props, links=stage.links, touches=stage.touches)
    both: list[Looked] = []
    rival = rival or learned
    for known in (learned, rival):
        if known is not None:
            known.check(tracker)
            given = known.config.played(given)
    for compliance in (stage.yields(given), None):
        others: tuple[Opponent, ...] = ()
        if opponent is not None:
            other = _against(opponent, tracker, compliance, _acting(rival, compliance), stage)
            others = (other,)
        events = (*stage.events, *others)
        own = replace(task.task, events=events, compliance=compliance, help_by="all")
        top = _acting(learned, compliance)
        if top is not None:
            own = replace(own, obs=(*own.obs, *seen(stage, top.config)))
        ahead = (lookahead or LookaheadConfig()) if controller == "lookahead" else None
        own = replace(task, task=own)
        both.append(_episodes(scene, tracker, own, count, threads, top, ahead, recover))
    return played(scene, both[0], both[1], name)


def _acting(learned: LearnedOnTop | None, given: Compliance | Stiffness | None) -> LearnedOnTop | None:
    """The policy on top that acts: one that has learned levels acts in the twin as well, which is its
    level 0."""
    levels = learned is not None and learned.config.drawn is not None
    return learned if levels or given is not None else None


def _against(
    task: Imitation,
    tracker: Tracker,
    given: Compliance | Stiffness | None,
    learned: LearnedOnTop | None,
    stage: SceneSetup,
) -> Opponent:
    """The other one of a stage, with what was learned on top of its policy, which sees what it feels."""
    (name,) = (p.name for p in stage.props if isinstance(p, Character))
    if learned is None:
        return opposing(task, tracker.policy, given, name=name)
    feeling = SceneSetup(obs=(feels(task.humanoid),))
    own = replace(task.task, obs=(*task.task.obs, *seen(feeling, learned.config)))
    topped = Topped(tracker.policy, learned.top, learned.added)
    return opposing(replace(task, task=own), topped, given, topped.begin, name)


def _title(scene: str, motion: str) -> str:
    return motion if scene in motion.split() else f"{scene}, {motion}"


def _episodes(
    scene: PlayScene,
    tracker: Tracker,
    task: Imitation,
    count: int,
    threads: int,
    learned: LearnedOnTop | None = None,
    lookahead: LookaheadConfig | None = None,
    recover: bool = False,
) -> Looked:
    topped = None if learned is None else Topped(tracker.policy, learned.top, learned.added)
    ahead = look_ahead(tracker, task, lookahead, threads) if lookahead else None
    begin = [] if topped is None else [topped.begin]
    begin += [] if ahead is None else [ahead.watch]
    acts, said = ahead or topped or tracker.policy, tracker.about
    clips = tracker.recovery_clips if recover else None
    if ahead is not None and clips is not None:
        ahead.copies.set_goal(Recovering(ahead.copies.goal.clips, clips, plans=False))
    try:
        return looked_at(scene, acts, task, count, threads, said, begin, tracker.config.method, clips)
    finally:
        if ahead is not None:
            ahead.copies.close()


def looked_at(
    scene: PlayScene,
    acts: Acts,
    task: Imitation,
    count: int,
    threads: int = 1,
    about: Mapping[str, Any] | None = None,
    begin: Sequence[Callable[[ImitationEnv], Any]] = (),
    method: str = "",
    recovery_clips: RecoveryClips | None = None,
) -> Looked:
    """Episodes of a task that stands in a scene, from the first frame off by `scene.starts`.

    Args:
        about: what the training of the policy took. begin: are told the environment before it acts.
        method: what the score card calls it.
        recovery_clips: by which a character gets up that has fallen; None leaves it where it is.
    """
    zero, watch = torch.zeros(count, dtype=torch.long), Watch(meter_of(scene))

    def make(worlds: int) -> ImitationEnv:
        env = task.env(worlds, None, False, threads, help_scale=0.0, guard=False)
        if recovery_clips is not None:
            env.reset_to(zero, zero)
            env.set_goal(Recovering(env.goal.clips, recovery_clips))
        watch.begin(env)
        for told in begin:
            told(env)
        return env

    rollouts, recordings = run_episodes(
        make,
        acts,
        zero,
        zero,
        cycles=1,
        observers=[watch],
        trial=torch.arange(count),
        spread=scene.starts,
    )
    card = scored(rollouts, task, about or {}, RULE, method)
    return Looked(task, rollouts, watch, Evaluation(card, rollouts, recordings, False))
