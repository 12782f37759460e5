"""Characters that go about without end: a kinematic policy says what comes next, and a control policy
that knows many motions does it (Residual Force Control, section 5), without help and without training.

made = dream(60)
made.clip, made.falls, made.save("out.bvh")
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from poise.env import Acts, ImitationEnv
from poise.env.generator_goal import GeneratorGoal, Steering
from poise.env.recovery.get_up import GetUpPlanner
from poise.env.recovery.recovering import Recovering
from poise.env.recovery.seats import Seats
from poise.errors import PoiseError
from poise.jobs.endless.dream_world import footprint, seats_of, with_boxes, with_help, with_pushes
from poise.jobs.endless.dreamt import (
    ClipMaker,
    Dream,
    Dreamt,
    DreamtCharacter,
    FrameStore,
    MotionWriter,
    Pieces,
)
from poise.jobs.endless.model import GeneratorModel, load_generator
from poise.jobs.open import open_run
from poise.jobs.track.controllers import NO_CRITIC, look_ahead
from poise.jobs.track.placement import place
from poise.jobs.track.pushed import unforeseen
from poise.jobs.track.recovery_run import helped
from poise.jobs.track.surroundings import crowd, places
from poise.jobs.track.tracking import imitation_of
from poise.jobs.tracker import Tracker
from poise.kinematics.rate import read_clip
from poise.kinematics.travel import find_travel, travelled
from poise.learn.run import interruptible
from poise.metrics import help_audit
from poise.motion import Clip
from poise.plan.rehearsal import FutureTrials, Rehearsal
from poise.recipes.imitation import Imitation
from poise.score import simulate
from poise.score.card import NO_HELP, Help
from poise.settings import changed
from poise.sim.guard import UnstableError
from poise.synthesis.generator import Kinematic

#: Is told what is done, and how many control steps of how many.
Show = Callable[[str, int, int], None]


def dream(
    seconds: float = 60.0,
    generator: GeneratorModel | str | Path | None = None,
    policy: Tracker | str | Path | None = None,
    config: Dream | None = None,
    *,
    seed_clip: Clip | str | Path | None = None,
    out: str | Path | None = None,
    progress: Show | None = None,
    **settings: Any,
) -> Dreamt:
    """Lets characters go about for some seconds.

    Args:
        generator: a kinematic policy, its file or its run's folder; by default the one that comes with
            Poise.
        policy: the control policy; by default the one that comes with Poise.
        config: how; `settings` are those that differ, such as temperature=0.8 or targets=((5, 0),).
        seed_clip: the motion goes on from the end of this clip, which may have another skeleton; by
            default from a second of the library, drawn by the seed.
        out: a motion file that is written as the motion is made, "NAME-2.bvh" and so on for further
            characters.
        progress: is told what is done.

    Raises:
        PoiseError: no such generator or policy, or they are of different bodies; a seed clip that is too
            short; no room for the file.
    """
    config = changed(config or Dream(), settings)
    if not 0.1 <= seconds <= 36_000:
        raise PoiseError(
            f"a motion lasts from 0.1 s to 10 hours, got {seconds:g} s", code="out-of-range"
        )
    tracker = policy if isinstance(policy, Tracker) else open_run(policy).tracker
    model = generator if isinstance(generator, GeneratorModel) else load_generator(generator)
    made = model.generator(tracker.humanoid, config.temperature, config.style)
    rate = tracker.config.sim.control_hz
    if model.fps != rate:
        raise PoiseError(
            f"the generator makes {model.fps:g} frames a second, the policy does {rate:g}",
            code="rate-differs",
        )
    steps = max(1, round(seconds * rate))
    notes: list[str] = []
    if config.recover and tracker.recovery_clips is None:
        notes.append("The policy has not learned to get up, so a character stays where it falls.")
    if config.controller == "lookahead" and tracker.value is None:
        notes.append(NO_CRITIC)
    pasts = begun(made, config, None if seed_clip is None else past_of(seed_clip, made, tracker))
    body = ClipMaker(tracker.humanoid.table, tracker.example, rate)
    characters = [
        DreamtCharacter(FrameStore(7 + len(model.hinges)), FrameStore(7 + len(model.hinges)))
        for _ in range(config.count)
    ]
    writers = [
        MotionWriter(path, tracker.example, steps * config.count)
        for path in ([] if out is None else names_of(Path(out), config.count))
    ]
    pieces = [
        Pieces(c.done, body, w.add, w.path.stem, config.hold_feet)
        for c, w in zip(characters, writers, strict=False)
    ]
    seen = _Seen(characters, pieces, steps, progress)
    try:
        with interruptible() as interrupt:
            seen.stopped = interrupt.is_set
            goal = _go_about(tracker, made, config, pasts, seed_clip is None, steps, seen, notes)
            interrupted = interrupt.is_set()
        for piece in pieces:
            piece.finish()
        paths = tuple(p for w in writers if (p := w.close()) is not None)
    finally:
        for writer in writers:
            writer.discard()
    rate_hz = tracker.config.sim.control_hz
    if config.help_limit > 0:
        notes.append(
            f"Helped: a hand that no real person has led the roots with up to {config.help_limit:g} N."
        )
    return Dreamt(
        visits=() if goal.seats is None else tuple(goal.seats.visits),
        strayed=goal.strayed(rate_hz), help=seen.help(config.help_limit, tracker.humanoid.mass),
        tracker=tracker, body=body, characters=tuple(characters),
        lost=tuple((i, s / rate) for i, s in goal.lost),
        back=tuple((i, s / rate) for i, s in goal.back),
        reached=tuple((i, s / rate) for i, s in goal.reached), config=config,
        notes=(*notes, *goal.notes), paths=paths, interrupted=interrupted,
    )  # fmt: skip


def begun(generator: Kinematic, config: Dream, past: Tensor | None) -> Tensor:
    """`(N, p, 7 + n)` pasts from which characters begin, side by side, the first at the origin."""
    rng = torch.Generator().manual_seed(config.seed)
    pasts = generator.begin(config.count, rng)
    if past is not None:
        pasts = past.double().expand(config.count, -1, -1).clone()
        pasts[..., :2] -= pasts[:, -1:, :2].clone()
    pasts[..., :2] += torch.tensor(places(config.count))[:, None]
    return pasts


def past_of(clip: Clip | str | Path, generator: Kinematic, tracker: Tracker) -> Tensor:
    """The last `(p, 7 + n)` frames of a clip on a policy's body, onto which it is retargeted.

    Raises:
        PoiseError: the clip cannot be read, or is too short.
    """
    clip = clip if isinstance(clip, Clip) else read_clip(clip)
    travel = find_travel(clip)
    clip = clip if travel is None else travelled(clip, travel)
    qpos = torch.tensor(place(clip, tracker).qpos)
    if len(qpos) < generator.past:
        raise PoiseError(
            f"the generator sees {generator.past} frames at {generator.fps:g} Hz, "
            f"{generator.past / generator.fps:.1f} s, and the seed clip has {len(qpos)}",
            clip.name, "Give a longer one", code="clip-too-short",
        )  # fmt: skip
    return qpos[-generator.past :]


def names_of(out: Path, count: int) -> list[Path]:
    """The file of each character's motion."""
    return [out, *(out.with_name(f"{out.stem}-{k}{out.suffix}") for k in range(2, count + 1))]


def _go_about(
    tracker: Tracker,
    made: Kinematic,
    config: Dream,
    pasts: Tensor,
    drawn: bool,
    steps: int,
    seen: _Seen,
    notes: list[str],
) -> Recovering:
    """Simulates until all steps are made or `seen` has seen enough; the goal that was followed.

    drawn: `pasts` are of the generator, and others will do as well.
    """
    sits, said = seats_of(config.supports)
    notes += said
    boxes = tuple(footprint(s) for s in config.supports)
    steering = Steering(config.targets, config.count > 1, config.path, boxes, bool(sits))
    going = bool(config.targets) or config.path is not None

    def goal(worlds: int, plans: bool) -> Recovering:
        clips = tracker.recovery_clips if config.recover else None
        # Each has its own wishes; where there is somewhere to go, that alone counts.
        wishing = made.wishing(0.0 if going else config.label_seconds, worlds)
        lead = max(config.lookahead.horizon, *tracker.config.window, 1) + 1
        motion = GeneratorGoal(
            wishing, tracker.humanoid, tracker.config.sim.control_hz, worlds, seed=config.seed,
            lead=lead, plans=plans, steering=steering,
            pasts=pasts if plans else pasts[:1].expand(worlds, -1, -1),
            simulated=config.past == "simulated",
        )  # fmt: skip
        seats = None
        if sits and plans and tracker.recovery_clips is not None:
            get_up = GetUpPlanner(tracker.recovery_clips, tracker.humanoid.table, motion.rate_hz)
            seats = Seats(sits, tracker.humanoid, get_up, worlds, boxes, config.seed)
        own = Recovering(motion, clips, plans=plans, seats=seats)
        own.reset(torch.arange(worlds))
        return own

    # The body's own task; what it follows is the goal.
    task = imitation_of(tracker, [place(tracker.example, tracker)])
    task = replace(task, task=replace(task.task, help_by="all"))
    task = with_pushes(with_boxes(task, config.supports, config.count), config.pushes, config.seed)
    actor = tracker
    if config.help_limit > 0:
        task, actor = with_help(task, tracker, config.help_limit)
    several = config.count > 1
    rows = crowd(task.humanoid, task.config.sim, config.count, task.props) if several else None
    env = task.env(1, None, False, 1, help_scale=helped(task), backend=rows)
    own = goal(config.count, True)
    seen.goal = own
    acts: Acts = actor.policy
    ahead = None
    if config.controller == "lookahead" and tracker.value is not None:
        acts = ahead = look_ahead(actor, task, config.lookahead, config.threads, config.seed)
        ahead.copies.set_goal(goal(ahead.copies.num_envs, False))
    rehearsal = None
    if config.tries > 1:
        acts = rehearsal = rehearsed(acts, actor, task, goal, config.tries, config.threads)
    try:
        while len(seen) < steps and not seen.stopped():
            # Characters stand where their motion is: at the beginning, and after a simulation went bad.
            if ahead is not None:
                ahead.watch(env)
            if rehearsal is not None:
                rehearsal.watch(env, own)
            env.backend.write(None, *own.start(None))
            env.age[:] = 0
            obs = env.set_goal(own)
            if rehearsal is not None and drawn and not len(seen):
                obs = other_pasts(env, own, rehearsal, made, config.seed + 1)
            try:
                simulate(env, acts, obs, steps - len(seen), seen)
            except UnstableError as problem:
                at = len(seen) / tracker.config.sim.control_hz
                notes.append(
                    f"The simulation went bad at {at:.1f} s ({problem.failures[0].cause}); all began "
                    "anew on their motion."
                )
                env.action[:] = 0
    finally:
        env.close()
        if ahead is not None:
            ahead.copies.close()
        if rehearsal is not None:
            rehearsal.trials.copies.close()
    return own


def rehearsed(
    acts: Acts,
    tracker: Tracker,
    task: Imitation,
    goal: Callable[[int, bool], Recovering],
    tries: int,
    threads: int = 0,
) -> Rehearsal:
    """A controller `acts` that chooses among so many futures before it goes on, see `plan.rehearsal`.

    Args:
        goal: makes what so many worlds follow; False where they are copies that make no frames.
    """
    copies = (
        unforeseen(task).bare().env(tries, None, False, threads, help_scale=helped(task), guard=False)
    )
    copies.set_goal(tried := goal(tries, False))
    return Rehearsal(acts, FutureTrials(tracker.policy, copies, tried.endless))


def trials_of(tracker: Tracker, generator: Kinematic, tries: int) -> FutureTrials:
    """Copies of a policy's character alone, in which so many futures are tried at once."""
    task = imitation_of(tracker, [place(tracker.example, tracker)]).bare()
    copies = task.env(tries, None, False, 1, help_scale=0.0, guard=False)
    lead = max((1, *tracker.config.window)) + 1
    rate = tracker.config.sim.control_hz
    # The copies' own motion is replaced, and wishes are those of other worlds.
    begins = generator.wishing(0.0)
    goal = GeneratorGoal(begins, tracker.humanoid, rate, tries, lead=lead, plans=False)
    goal.reset(torch.arange(tries))
    copies.set_goal(goal)
    return FutureTrials(tracker.policy, copies, goal)


#: Pasts that are drawn until a copy of a character can go on from one.
BEGINS = 16


def other_pasts(
    env: ImitationEnv, goal: Recovering, rehearsal: Rehearsal, generator: Kinematic, seed: int
) -> Tensor:
    """Draws other pasts where no copy of a character goes on from its own, since some are in the middle
    of a leap; the observations `(N, O)` from which they begin."""
    rng, pasts = torch.Generator().manual_seed(seed), goal.endless.pasts
    assert pasts is not None
    for _ in range(BEGINS):
        stuck = torch.tensor(rehearsal.begin(), dtype=torch.long)
        if not len(stuck):
            break
        where = pasts[stuck, -1:, :2].clone()
        pasts[stuck] = generator.begin(len(stuck), rng)
        pasts[stuck, :, :2] += where
        goal.reset(stuck)
        env.backend.write(stuck, *goal.start(stuck))
    return env.observe()


class _Seen:
    """Observes where characters are, and where they were to be.

    Attributes:
        goal: what they follow. stopped: whether Ctrl-C was pressed.
    """

    goal: Recovering
    stopped: Callable[[], bool]

    def __init__(
        self, characters: list[DreamtCharacter], pieces: list[Pieces], steps: int, show: Show | None
    ):
        self.characters, self.pieces, self.steps, self.show = characters, pieces, steps, show
        # Of each control step `(4, K, 1, 3)`: force, torque, and how the root moves, see `help_audit`.
        self._helped = list[Tensor]()

    def __len__(self) -> int:
        return self.characters[0].done.count

    def see(self, env: ImitationEnv, step: int) -> bool:
        """Keeps a control step; the state before the first one is that of the past, which is known."""
        if step == 0:
            return self.stopped()
        asked = self.goal.start(None)[0]
        for k, character in enumerate(self.characters):
            character.done.append(env.backend.state.qpos[k].cpu().numpy())
            character.asked.append(asked[k].cpu().numpy())
        for piece in self.pieces:
            piece.more()
        if (wrench := env.wrench) is not None:
            pose = env.pose()
            parts = wrench.force, wrench.torque, pose.linvel[:, :1], pose.angvel[:, :1]
            self._helped.append(torch.stack([p.double() for p in parts]))
        if self.show is not None:
            self.show("going about", len(self), self.steps)
        return self.stopped()

    def help(self, limit: float, mass: float) -> Help:
        """The help that a hand gave with up to `limit` N and N m, to characters of `mass` kg."""
        if not self._helped:
            return NO_HELP
        force, torque, goes, spins = torch.stack(self._helped, 1).unbind(0)
        found = help_audit(force, torque, goes, spins, mass)
        names = ("force_mean_n", "force_p95_n", "torque_mean_nm", "torque_p95_nm", "work_j_per_s")
        used = (getattr(found, name) for name in (*names, "share_of_body_weight"))
        return Help(limit, limit, *used)
