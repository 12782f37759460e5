"""Goals of every kind: what a policy is told, and what is said where something goes wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from poise.env import ImitationEnv
from poise.env import evaluate as recording
from poise.env.events import Event, StepOutcome
from poise.env.generator_goal import GeneratorGoal
from poise.env.goal import FADE_S, Goal, extrapolated
from poise.env.stream_goal import StreamGoal
from poise.env.yielding import DisplacedGoal
from poise.motion import ClipLibrary
from poise.recipes import ResidualForce, build
from poise.recipes.imitation import Imitation
from poise.sim import Backend, difference, make_backend
from refusals import refused
from toy_human import swing


@pytest.fixture(scope="module")
def task() -> Imitation:
    return build(ClipLibrary.of([swing(1.5, name="calm")]), ResidualForce(num_envs=2, expert=False))


def env_of(task: Imitation, goal: Goal) -> ImitationEnv:
    backend = make_backend(task.model, goal.num_envs, "cpu", threads=1)
    plain = replace(task.task, auto_reset=False, help=None)
    return ImitationEnv(goal, backend, plain, task.config.sim.substeps)


def stream_of(task: Imitation, frames: int = 5, worlds: int = 1) -> StreamGoal:
    goal = StreamGoal(task.humanoid, task.reference.rate_hz, worlds)
    for qpos in task.reference.qpos[:frames]:
        goal.push(qpos)
    return goal


def still(env: ImitationEnv) -> Tensor:
    return torch.zeros(env.num_envs, env.num_actions)


# --- streams ----------------------------------------------------------------------------------------


def test_a_stream_says_what_its_clip_says(task: Imitation) -> None:
    goal, clip = stream_of(task, 1), task.env(1, auto_reset=False, threads=1, help_scale=0.0)
    env = env_of(task, goal)
    zero = torch.zeros(1, dtype=torch.long)
    env.help.set(0.0)
    env.reset()
    clip.reset_to(zero, zero)
    for k in range(1, 30):
        goal.push(task.reference.qpos[k])
        a, b = env.goal.ahead(), clip.goal.ahead()
        seen, told = env.goal.layout.unpacked(a), clip.goal.layout.unpacked(b)
        torch.testing.assert_close(seen.pos, told.pos, atol=1e-5, rtol=0)
        torch.testing.assert_close(seen.quat, told.quat, atol=1e-5, rtol=0)
        # The velocity of the past half step, not that of the next one.
        assert float((seen.linvel - told.linvel).norm(dim=-1).max()) < 0.3
        (mine, row), (theirs, rows) = goal.targets(), clip.goal.targets()
        assert torch.equal(mine[row], theirs[rows])
        env.step(still(env))
        clip.step(still(clip))
    assert not goal.notes
    env.close()
    clip.close()


def test_what_is_recorded_of_a_stream_is_what_was_read_before(
    task: Imitation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the last bit, for frames that are known and for those that are not."""

    def told(often: int) -> list[Tensor]:
        monkeypatch.setattr(recording, "OFTEN", often)
        goal, every, out = stream_of(task, 1, 2), torch.arange(2), list[Tensor]()
        goal.reset(every)
        for k in range(1, 12):
            if k % 4:
                goal.push(task.reference.qpos[k], None if k % 3 else every[:1])
            goal.at += 1
            goal.aim(None, None)
            out += [goal.now(), goal.ahead(), goal.window((1, 2, 4)), goal.packs, goal.qvel]
        return [x.clone() for x in out]

    plain, recorded = told(10**9), told(2)
    assert all(torch.equal(a, b) for a, b in zip(plain, recorded, strict=True))


def test_a_stream_that_stalls_comes_to_rest_and_says_so(task: Imitation) -> None:
    goal = stream_of(task)
    env = env_of(task, goal)
    env.reset()
    for _ in range(60):
        step = env.step(still(env))
    assert step.obs.isfinite().all()
    assert goal.notes == ["The stream has stalled for 0.25 s; the goal comes to rest (frame 12)."]
    assert float(goal.layout.unpacked(goal.ahead()).linvel.abs().max()) < 1e-3
    # It goes on where frames arrive again.
    goal.push(task.reference.qpos[5])
    env.step(still(env))
    env.close()


def test_a_stream_that_jumps_or_sends_no_pose_is_told(task: Imitation) -> None:
    goal = stream_of(task)
    far, torn = task.reference.qpos[5].clone(), task.reference.qpos[5].clone()
    far[0] += 4.0
    torn[9] = float("nan")
    goal.push(torn)
    assert goal.count.tolist() == [5]
    goal.push(far)
    goal.push(far.clone())
    assert len(goal.notes) == 2
    assert "sent a frame that is no pose, which is left out" in goal.notes[0]
    assert "jumped by 4.0 m between two frames" in goal.notes[1]
    # A jump has no velocity.
    env = env_of(task, goal)
    env.reset()
    speed = goal.layout.unpacked(goal.now()).linvel
    assert float(speed.abs().max()) < 1.0
    env.close()
    with refused("wrong-shape"):
        goal.push(torch.zeros(3))


def test_a_stream_that_ends_is_done(task: Imitation) -> None:
    goal = stream_of(task, 1)
    env = env_of(task, goal)
    env.reset()
    with refused("nothing-arrived"):
        env_of(task, StreamGoal(task.humanoid, 60.0)).reset()
    goal.push(task.reference.qpos[1])
    goal.push(task.reference.qpos[2])
    goal.close()
    done = [bool(env.step(still(env)).terminated) for _ in range(3)]
    assert done == [False, True, True] and goal.notes == ["The stream ended (frame 0)."]
    env.close()


# --- generators -------------------------------------------------------------------------------------


class Walks:
    """Moves the root on at 1 m/s; breaks after some frames where it is told to."""

    past, future = 2, 5

    def __init__(self, task: Imitation, worlds: int, breaks: int = 10_000):
        self.pose, self.breaks = task.reference.qpos[0], breaks
        self.made = torch.zeros(worlds, dtype=torch.long)

    def begin(self, count: int, rng: torch.Generator) -> Tensor:
        return self.pose.expand(count, self.past, -1).clone()

    def generate(self, past: Tensor, ids: Tensor, rng: torch.Generator) -> Tensor:
        steps = torch.arange(1, self.future + 1, dtype=torch.float64)
        out = past[:, -1:].repeat(1, self.future, 1)
        out[:, :, 0] += steps / 60.0
        out[:, :, 7] += 0.01 * torch.randn(len(ids), 1, generator=rng, dtype=torch.float64)
        self.made[ids] += self.future
        out[self.made[ids] > self.breaks] = float("nan")
        return out

    def rows(self) -> Mapping[str, Tensor]:
        return {"made": self.made}


def test_a_generator_goes_on_without_end_and_is_copied_with_its_world(task: Imitation) -> None:
    goal = GeneratorGoal(Walks(task, 2), task.humanoid, 60.0, 2, seed=7)
    env = env_of(task, goal)
    env.reset()
    for k in range(1, 200):
        env.step(still(env))
        now = goal.layout.unpacked(goal.now())
        assert now.qpos[:, 0] == pytest.approx(
            [float(task.reference.qpos[0, 0]) + k / 60.0] * 2, abs=1e-4
        )
    shot = env.snapshot()
    first = [env.step(still(env)).obs.clone() for _ in range(20)]
    env.restore(shot)
    again = [env.step(still(env)).obs.clone() for _ in range(20)]
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True)) and not goal.notes
    # All copies of one world see the same future.
    one = env.snapshot(torch.tensor([0]))
    env.restore(one, torch.tensor([0, 1]))
    assert torch.equal(goal.ahead()[0], goal.ahead()[1])
    env.close()


def test_a_generator_that_makes_no_motion_stands_still_and_says_so(task: Imitation) -> None:
    goal = GeneratorGoal(Walks(task, 1, breaks=12), task.humanoid, 60.0, 1)
    env = env_of(task, goal)
    env.reset()
    for _ in range(30):
        step = env.step(still(env))
    assert step.obs.isfinite().all() and bool(step.terminated)
    assert goal.notes == [
        "The generator made what is no motion in world 0 after frame 11; "
        "the character is to stand still there."
    ]
    env.close()

    class Wrong(Walks):
        def generate(self, past: Tensor, ids: Tensor, rng: torch.Generator) -> Tensor:
            return past[:, :, :5]

    with refused("wrong-shape", says="(1, 2, 5)"):
        env_of(task, GeneratorGoal(Wrong(task, 1), task.humanoid, 60.0)).reset()


# --- what wraps a goal, and what is not known -------------------------------------------------------


def test_a_displaced_goal_is_moved_and_nothing_else(task: Imitation) -> None:
    env = task.env(2, auto_reset=False, threads=1, help_scale=0.0)
    zero = torch.zeros(2, dtype=torch.long)
    env.reset_to(zero, zero)
    goal = DisplacedGoal(env.goal)
    plain = goal.goal.ahead().clone()
    assert torch.equal(env.set_goal(goal), env.observe()) and torch.equal(goal.ahead(), plain)
    goal.offset[1, :3] = torch.tensor([0.2, 0.0, 0.1])
    moved, kept = goal.layout.unpacked(goal.ahead()), goal.layout.unpacked(plain)
    assert torch.equal(moved.pos[0], kept.pos[0])
    off = moved.pos[1] - kept.pos[1]
    torch.testing.assert_close(off, torch.tensor([0.2, 0.0, 0.1]).expand_as(off), atol=1e-5, rtol=0)
    goal.offset[1, 6] = 0.3
    table, rows = goal.targets()
    hinges, of = goal.goal.targets()
    assert float((table[rows] - hinges[of])[1, 0]) == pytest.approx(0.3)
    env.close()


def test_the_unknown_is_extrapolated_in_one_way(task: Imitation) -> None:
    qpos, qvel = task.reference.qpos[5:6], task.reference.qvel[5:6]
    rate = task.reference.rate_hz
    for steps in (1, 6, 600):
        q, v = extrapolated(qpos, qvel, torch.tensor([steps]), rate)
        left = 2.718281828 ** (-steps / rate / FADE_S)
        torch.testing.assert_close(v, qvel * left, atol=1e-6, rtol=1e-6)
        moved = difference(q, qpos)
        torch.testing.assert_close(moved, qvel * FADE_S * (1 - left), atol=1e-6, rtol=1e-5)


def test_a_clip_of_one_frame_is_refused_in_a_sentence() -> None:
    clip = swing(1.0)
    with refused("clip-too-short", says="1"):
        build(clip.replaced(root_pos=clip.root_pos[:1], rot=clip.rot[:1], name="one"))


def test_goals_without_clips_say_so(task: Imitation) -> None:
    goal = stream_of(task)
    env = env_of(task, goal)
    for ask in (lambda: env.reference, lambda: env.seek(goal.at, goal.at), lambda: env.weights):
        with refused("goal-without-clips", says="StreamGoal"):
            ask()
    env.close()


def test_plug_ins_of_a_task_are_made_for_each_environment_and_asked_together(task: Imitation) -> None:
    class Ends(Event):
        """Cuts off every episode in every other step."""

        def __init__(self, goal: Goal, backend: Backend):
            self.steps = 0

        def after_step(self) -> None:
            self.steps += 1

        def judged(self, outcome: StepOutcome) -> None:
            outcome.ends[2] = self.steps % 2 == 1

    class Ticks(Event):
        """Is told of every step, and says nothing."""

        def __init__(self, goal: Goal, backend: Backend):
            self.ticks = 0

        def after_step(self) -> None:
            self.ticks += 1

    own = replace(task, task=replace(task.task, events=(Ticks, Ends), auto_reset=False))
    env, other = (own.env(1, auto_reset=False, threads=1) for _ in range(2))
    zero = torch.zeros(1, dtype=torch.long)
    env.reset_to(zero, zero)
    cut = [bool(env.step(still(env)).truncated) for _ in range(6)]
    ticks, ends = env.event(Ticks), env.event(Ends)
    assert ticks is not None and ends is not None and ticks.ticks == ends.steps == 6
    assert cut == [True, False] * 3
    assert other.event(Ticks) is not ticks and other.event(Ticks).ticks == 0  # type: ignore[union-attr]
    env.close()
    other.close()


def test_a_streams_lowest_root_is_that_of_all_its_frames(task: Imitation) -> None:
    goal = StreamGoal(task.humanoid, task.reference.rate_hz)
    pose = task.reference.qpos[0]
    for k in range(100):
        goal.push(torch.cat((pose[:2], pose[2:3] - 0.2 * (k == 3), pose[3:])))
    goal.at[:] = 98
    low = goal.layout.place(goal.now()).low
    assert float(low) == pytest.approx(float(pose[2]) - 0.2, abs=1e-6)
