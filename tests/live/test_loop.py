"""The loop by a clock of its own: people come, err, go; characters follow, fall and get up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from majority import majority
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.live.characters import EASE, FALLS, RETURNS, TRACKS
from poise.live.protocol import LiveConfig
from poise.live.session import Live, generator_for
from poise.live.sources import Loop, packet_of
from poise.live.stream import Packet
from poise.motion import Clip
from refusals import refused
from test_docs import WALK

STEP = 1 / 30


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


@pytest.fixture(scope="module")
def walk() -> Clip:
    return read_clip(WALK)


class Played:
    """A loop with people that walk, 30 packets a second each."""

    def __init__(
        self, tracker: Tracker, walk: Clip, config: LiveConfig, people: tuple[str, ...] = ("a",)
    ):
        self.live, self.loop, self.people = (
            Live(tracker, config, clock=lambda: self.now),
            Loop(walk),
            people,
        )
        self.now, self.frame = 0.0, 0

    def run(self, seconds: float, sends: bool = True) -> None:
        for _ in range(round(seconds / STEP)):
            for name in self.people if sends else ():
                self.live.inbox.offer(packet_of(name, self.loop, self.frame), self.now)
            self.live.step(self.now)
            self.frame += 1
            self.now += STEP


def test_a_character_follows_is_knocked_over_and_gets_up(tracker: Tracker, walk: Clip) -> None:
    def check(seed: int) -> None:
        played = Played(tracker, walk, LiveConfig(seed=seed))
        character = played.live.world.characters[0]
        played.run(2.0)
        assert character.doing == TRACKS and played.live.world.body(0).off_m < 0.3
        # Not every blow fells it: some it comes back from on its feet.
        for knock in range(1, 7):
            before = played.live.world.rows.state.qpos[0, :3].clone()
            played.live.commands.append({"type": "knock", "character": 0})
            played.run(1.0)
            assert character.doing in (FALLS, RETURNS) and character.lost == knock
            for _ in range(20):
                played.run(0.5)
                if character.doing == TRACKS and played.live.world.body(0).off_m < 0.3:
                    break
            assert character.doing == TRACKS and character.recovered >= knock
            # It goes on from where it got up.
            assert float((played.live.world.rows.state.qpos[0, :2] - before[:2]).norm()) < 6.0
            if character.falls:
                break
        told = played.live.figures()
        assert told["help_n"] == 0.0 and told["characters"][0]["falls"] >= 1
        played.live.close()

    majority(check)


def test_who_goes_away_is_waited_for_at_ease(tracker: Tracker, walk: Clip) -> None:
    played = Played(tracker, walk, LiveConfig(buffer_s=0.2))
    character = played.live.world.characters[0]
    played.run(1.0)
    played.run(2.5, sends=False)
    assert character.doing == EASE and character.falls == 0
    assert played.live.world.body(0).off_m < 0.2
    played.run(1.2)
    assert character.doing == TRACKS
    played.live.close()


def test_people_take_characters_change_them_and_are_forgotten(tracker: Tracker, walk: Clip) -> None:
    played = Played(tracker, walk, LiveConfig(characters=2), ("a", "b", "c"))
    played.run(0.2)
    live = played.live
    assert live.people.follows == ["a", "b"] and set(live.people.known) == {"a", "b", "c"}
    live.commands.append({"type": "follow", "character": 0, "person": "b"})
    played.run(0.1)
    assert live.people.follows == ["b", "a"]
    live.commands.append({"type": "follow", "character": 1, "person": "c"})
    live.commands.append({"type": "knock", "character": 9})
    played.run(0.1)
    assert live.people.follows == ["b", "c"]
    played.now += 30.0
    played.people = ("c",)
    for _ in range(31):
        played.run(STEP)
    assert live.people.follows == [None, "c"]
    live.close()


def test_nobody_who_moves_is_calibrated_and_who_stands_is(tracker: Tracker, walk: Clip) -> None:
    live, now = Live(tracker, clock=lambda: 0.0), 0.0
    for k in range(150):
        # Walks for 2 s, then stands for 2.5 s; other proportions are another size.
        t = min(k, 60) % walk.frames
        root = walk.root_pos[t]
        packet = Packet("a", now, walk.skeleton, root, walk.rot[t])
        live.inbox.offer(packet, now)
        if k % 3 == 0 or k > 55:
            live.step(now)
        person = live.people.of(0)
        if k == 58:
            assert person is not None and person.onto is None and person.share < 1
        now += STEP
    assert person is not None and person.onto is not None
    # It stands where the character does.
    assert float(np.abs(live.world.body(0).qpos[:2].numpy()).max()) < 0.5
    live.close()


def test_buffer_noise_and_pause_are_set_while_it_runs(tracker: Tracker, walk: Clip) -> None:
    played = Played(tracker, walk, LiveConfig(buffer_s=0.0))
    played.run(0.5)
    live = played.live
    assert live.world.lead == [1]
    live.commands.append({"type": "set", "buffer": 0.4, "noise": 0.5, "lookahead": 1})
    played.run(0.5)
    assert live.world.lead == [7] and live.aims.noise == 0.5 and live.world.ahead_of == (0,)
    steps = live.steps
    live.commands.append({"type": "pause", "on": True})
    played.run(0.3)
    assert live.paused and live.steps == steps
    live.commands.append({"type": "pause", "on": False})
    live.commands.append({"type": "ball", "character": 0})
    live.commands.append(
        {"type": "pull", "character": 0, "body": 3, "point": [0, 0, 0], "to": [0, 0, 1]}
    )
    played.run(0.2)
    assert live.steps > steps and 0 in live.world.hands.pulls
    # A hand that says nothing more has let go.
    played.run(1.2)
    assert live.world.hands.pulls == {}
    live.close()


def test_a_dial_lets_a_character_give_way(tracker: Tracker, walk: Clip) -> None:
    """The same pull moves the goal of a compliant character alone, and the goal comes back."""
    live = Live(tracker, LiveConfig(characters=2), clock=lambda: 0.0)
    world, row = live.world, live.world.humanoid.rows_of("hand")[0]
    live.commands.append({"type": "comply", "character": 1, "level": 0.5})
    for k in range(10):
        live.step(k * STEP)
    for c in range(2):
        at = world.rows.state.xpos[c, row + 1].double().numpy()
        world.hands.pull(c, row, np.zeros(3), at + np.array([0.3, 0, 0]))
        live.orders.pulled[c] = 0.3
    for k in range(12):
        live.step(0.3 + k * STEP)
    moved = world.yielding.goal.offset.abs().amax(1)
    assert float(moved[0]) == 0.0 and float(moved[1]) > 0.01
    assert [c["compliance"] for c in live.figures()["characters"]] == [0.0, 0.5]
    for c in range(2):
        world.hands.let_go(c)
    for k in range(60):
        live.step(0.7 + k * STEP)
    assert float(world.yielding.goal.offset.abs().max()) < 0.02
    live.close()


def test_endless_motion_begins_and_ends(tracker: Tracker) -> None:
    made = generator_for(tracker)
    assert made is not None
    live = Live(tracker, clock=lambda: 0.0, generator=made)
    live.commands.append({"type": "dream", "character": 0, "on": True})
    heights = []
    for k in range(90):
        seen = live.step(k * STEP)
        assert seen is not None
        heights.append(seen.qpos[0, 2])
    character = live.world.characters[0]
    assert character.doing in (TRACKS, FALLS, RETURNS) and live.figures()["characters"][0]["endless"]
    # It begins where the character stood.
    assert np.abs(live.world.body(0).qpos[:2].numpy()).max() < 6.0 and np.isfinite(heights).all()
    live.commands.append({"type": "dream", "character": 0, "on": False})
    for k in range(5):
        live.step(3.0 + k * STEP)
    assert not live.aims.endless and character.doing != TRACKS
    live.close()


def test_a_pull_is_a_spring(tracker: Tracker, walk: Clip) -> None:
    """The chest of a character at ease goes where it is drawn, and comes back."""
    live = Live(tracker, clock=lambda: 0.0)
    chest = live.world.humanoid.rows_of("spine")[-1]
    place = live.world.rows.state.xpos
    for k in range(10):
        live.step(k * STEP)
    before = place[0, chest + 1].clone()
    live.world.hands.pull(0, chest, np.zeros(3), before.double().numpy() + np.array([0.25, 0, 0]))
    live.orders.pulled[0] = 0.0
    for k in range(15):
        live.step(0.3 + k * STEP)
    moved = float(place[0, chest + 1, 0] - before[0])
    assert 0.03 < moved < 0.3
    live.close()


def test_a_slow_machine_makes_slow_motion_and_no_falls(tracker: Tracker, walk: Clip) -> None:
    played = Played(tracker, walk, LiveConfig())
    played.run(1.5)
    for _ in range(40):
        # Each step takes as long as two.
        for _ in range(2):
            played.live.inbox.offer(packet_of("a", played.loop, played.frame), played.now)
            played.frame += 1
            played.now += STEP
        played.live.step(played.now)
    played.run(3.0)
    assert played.live.world.characters[0].lost == 0
    assert played.live.aims.read_s is not None and played.now - played.live.aims.read_s < 1.3
    played.live.close()


@pytest.mark.parametrize(
    "wrong", [{"characters": 0}, {"buffer_s": 0.5}, {"lookahead": 2}, {"noise": float("nan")}]
)
def test_settings_that_make_no_sense(wrong: dict) -> None:
    with refused("out-of-range"):
        LiveConfig(**wrong)


def test_a_clip_is_played_on_without_a_jump(walk: Clip) -> None:
    loop = Loop(walk)
    far = [float(np.linalg.norm(loop(k + 1)[0] - loop(k)[0])) for k in range(3 * walk.frames)]
    assert max(far) < 0.08
    # It walks on; the clip's own way three times.
    assert np.linalg.norm(loop(3 * walk.frames)[0][:2] - loop(0)[0][:2]) > 2.2 * np.linalg.norm(
        walk.root_pos[-1, :2] - walk.root_pos[0, :2]
    )


def test_a_clip_passes_over_where_its_ends_are_most_alike(walk: Clip) -> None:
    """A walk that ends in the middle of a step goes on in step."""

    def apart(a: int, b: int) -> float:
        return float((1.0 - np.abs((walk.rot[a, 1:] * walk.rot[b, 1:]).sum(-1))).sum())

    loop = Loop(walk)
    assert 0 <= loop.first < loop.last - loop.fade and loop.last + loop.fade <= walk.frames
    assert apart(loop.first, loop.last) < apart(0, walk.frames - loop.fade)
    for frames in (2, 3, 7):
        short = Loop(walk.replaced(root_pos=walk.root_pos[:frames], rot=walk.rot[:frames]))
        assert all(np.isfinite(short(k)[0]).all() for k in range(20))


def test_characters_take_the_proportions_of_an_avatar(tracker: Tracker, walk: Clip) -> None:
    """`poise live --bones FILE`: lengths and masses are the avatar's, and it is still tracked."""
    skeleton = replace(walk.skeleton, offsets=0.7 * walk.skeleton.offsets)
    small = walk.replaced(skeleton=skeleton, root_pos=0.7 * walk.root_pos)
    own = tracker.with_bones_of(small)
    mass, less = (float(t.humanoid.model.body_mass.sum()) for t in (tracker, own))
    assert less < 0.7 * mass
    played = Played(own, small, LiveConfig())
    live, rows = played.live, own.humanoid.table.rows
    played.run(0.3)
    seen = live.step(played.now)
    assert seen is not None and bool(live.world.rows.state.qpos.isfinite().all())
    parents = np.array([r.parent for r in rows[1:]])
    for bodies in (seen.bodies[0], seen.goals[0]):
        long = np.linalg.norm(bodies[1:, :3] - bodies[parents, :3], axis=-1)
        whole = np.linalg.norm([r.pos for r in tracker.humanoid.table.rows[1:]], axis=-1)
        assert np.allclose(long, np.linalg.norm([r.pos for r in rows[1:]], axis=-1), atol=2e-3)
        assert long.sum() < 0.85 * whole.sum()
    live.close()


def test_whole_turns_of_a_fallen_character_are_left_out(tracker: Tracker, walk: Clip) -> None:
    """The pose stays where it is, and so do the bodies."""
    played = Played(tracker, walk, LiveConfig())
    played.run(0.3)
    world, recovery = played.live.world, tracker.recovery_clips
    assert recovery is not None
    character = world.characters[0]
    joint = int((world.humanoid.model.jnt_range[1:, 0] < -8.0).nonzero()[0][0])
    state = world.rows.state
    for falls in (False, True):
        if falls:
            # It lies where it stood, and slides.
            lies, slides = state.qpos.clone(), torch.zeros_like(state.qvel)
            lies[0, 2:] = recovery.ups[0][0, 2:].to(lies)
            slides[0, 0] = 4.0
            world.rows.write(None, lies, slides)
            played.run(2 * STEP)
        assert (character.doing == FALLS) == falls and world.unwound == 0
        qpos, qvel = state.qpos.clone(), state.qvel.clone()
        qpos[0, 7 + joint] -= 2 * np.pi
        world.rows.write(None, qpos, qvel)
        before = state.xpos.clone()
        world.unwind()
        assert world.unwound == falls
        if not falls:
            assert torch.equal(state.qpos, qpos)
            qpos[0, 7 + joint] += 2 * np.pi
            world.rows.write(None, qpos, qvel)
    assert np.allclose(state.qpos[0, 7 + joint], qpos[0, 7 + joint] + 2 * np.pi, atol=1e-5)
    assert np.allclose(state.xpos, before, atol=1e-4) and np.allclose(state.qvel, qvel)
    played.live.close()
