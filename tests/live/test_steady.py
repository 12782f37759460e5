"""Streams that tremble: smoothed on their way in, one control step later, and clean ones left alone."""

from __future__ import annotations

import numpy as np
import pytest

from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.kinematics.retargeting.passage import world_of
from poise.kinematics.stream_noise import LATE_S
from poise.live.people import Person, Steady
from poise.live.points import PointFit
from poise.live.session import _of_tremble
from poise.live.sources import KeypointFrame, Loop
from poise.live.stream import Inbox, JitterBuffer, Packet, StreamTremble, margin
from poise.motion import Clip, Skeleton
from poise.motion.rotations import normalize, quat_mul, quat_rotate
from test_docs import WALK

STEP = 1 / 30


@pytest.fixture(scope="module")
def walk() -> Clip:
    return read_clip(WALK)


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


def stream(walk: Clip, seconds: float, turn: float, hz: float = 0.0, name: str = "a") -> list[Packet]:
    """A walk without end whose joints err by `turn` rad in every axis; at one frequency where one is
    given."""
    loop, rng = Loop(walk), np.random.default_rng(0)
    phase, out = rng.uniform(size=(len(walk.skeleton), 3)), list[Packet]()
    for k in range(round(seconds * walk.fps)):
        root, rot = loop(k)
        err = rng.normal(size=phase.shape)
        if hz:
            err = np.sqrt(2) * np.sin(2 * np.pi * (hz * k / walk.fps + phase))
        turned = normalize(np.concatenate((np.ones((len(err), 1)), 0.5 * turn * err), 1))
        out.append(Packet(name, k / walk.fps, walk.skeleton, root, quat_mul(rot, turned), walk))
    return out


def places(skeleton: Skeleton, root: np.ndarray, rot: np.ndarray) -> np.ndarray:
    """`(J, 3)` m."""
    world, out = world_of(skeleton, rot), [root]
    for j, parent in enumerate(skeleton.parents[1:], 1):
        out.append(out[parent] + quat_rotate(world[parent], skeleton.offsets[j]))
    return np.stack(out)


def off_mm(root: np.ndarray, rot: np.ndarray, truth: Packet) -> float:
    """mm between joints, root of the mean square."""
    there = places(truth.skeleton, truth.root_pos, truth.rot)
    apart = np.linalg.norm(places(truth.skeleton, root, rot) - there, axis=-1)
    return 1e3 * float(np.sqrt((apart**2).mean()))


def through(packets: list[Packet], at_once: int = 1) -> Person:
    """Who has got these packets, so many at once."""
    inbox, person = Inbox(Steady), Person(packets[0].person, 0.1)
    for k, packet in enumerate(packets):
        assert inbox.offer(packet, packet.time_s)
        if k % at_once == at_once - 1 or k == len(packets) - 1:
            for arrived, came in inbox.take()["a"]:
                person.add(came, arrived, lambda *_: "no body")
    return person


def test_a_clean_stream_is_left_alone_and_no_later(walk: Clip) -> None:
    packets, inbox = stream(walk, 8.0, 0.0), Inbox(Steady)
    for packet in packets:
        inbox.offer(packet, packet.time_s)
        ((_, came),) = inbox.take()["a"]
        # As it came but for its length, which is made one.
        np.testing.assert_array_equal(came.rot, normalize(packet.rot))
        assert came.root_pos is packet.root_pos and came.earlier == ()
        assert came.tremble is not None and came.tremble.mm == came.tremble.late_s == 0.0


@pytest.mark.parametrize(("hz", "left"), [(0.0, 0.62), (5.0, 0.35)])
def test_a_trembling_stream_is_smoothed_a_step_later(walk: Clip, hz: float, left: float) -> None:
    truth, dirty = stream(walk, 9.0, 0.0), stream(walk, 9.0, 0.03, hz)
    inbox, known, raw, came = Inbox(Steady), list[float](), list[float](), dirty[0]
    for k, packet in enumerate(dirty):
        inbox.offer(packet, packet.time_s)
        ((_, came),) = inbox.take()["a"]
        if packet.time_s > 5.0:
            earlier = came.earlier[0]
            assert earlier.time_s == dirty[k - 1].time_s
            known.append(off_mm(earlier.root_pos, earlier.rot, truth[k - 1]))
            raw.append(off_mm(packet.root_pos, packet.rot, truth[k]))
    assert came.tremble is not None and came.tremble.late_s == LATE_S and np.mean(raw) > 10
    assert np.mean(known) < left * np.mean(raw)
    assert came.tremble.hz == (pytest.approx(5.0, abs=0.1) if hz else None)
    told = _of_tremble(came.tremble)
    # Told for joints that err by themselves; tones of one phase each partly undo each other for good.
    size = np.sqrt(np.mean(np.square(raw)))
    assert told["trembles_mm"] == pytest.approx(size, rel=0.35 if hz else 0.15)
    assert told["late_ms"] == 33


def test_what_is_read_is_later_by_what_is_stated(walk: Clip) -> None:
    truth, dirty = stream(walk, 9.0, 0.0), stream(walk, 9.0, 0.03)
    person, clean = through(dirty), through(truth)
    now = dirty[-1].time_s
    for buffer, late in ((person.buffer, LATE_S), (clean.buffer, 0.0)):
        assert buffer.tremble.late_s == late
        pose = buffer.read(now)
        assert pose is not None
        at = now - margin(0.1) - late
        k = round(at * walk.fps - 0.5)
        share = at * walk.fps - k
        there = truth[k].root_pos + share * (truth[k + 1].root_pos - truth[k].root_pos)
        np.testing.assert_allclose(pose.root_pos, there, atol=1e-6 if not late else 0.005)


def test_packets_at_once_make_no_difference(walk: Clip) -> None:
    dirty = stream(walk, 4.0, 0.03)
    one, five = through(dirty).buffer, through(dirty, 5).buffer
    for a, b in zip(one.frames, five.frames, strict=True):
        np.testing.assert_array_equal(a.root_pos, b.root_pos)
        np.testing.assert_array_equal(a.rot, b.rot)
    # Nor do packets that come late, which are left out, or twice.
    inbox, person = Inbox(Steady), Person("a", 0.1)
    for k, packet in enumerate(dirty):
        inbox.offer(packet, packet.time_s)
        inbox.offer(dirty[max(k - 2, 0)], packet.time_s)
    for arrived, came in inbox.take()["a"]:
        person.add(came, arrived, lambda *_: "no body")
    np.testing.assert_array_equal(person.buffer.frames[-1].rot, one.frames[-1].rot)


def test_who_is_elsewhere_is_there_at_once(walk: Clip) -> None:
    dirty = stream(walk, 6.0, 0.03)
    k = round(5.0 * walk.fps)
    for j in range(k, len(dirty)):
        p = dirty[j]
        dirty[j] = Packet("a", p.time_s, p.skeleton, p.root_pos + np.eye(3)[0] * 5.0, p.rot, walk)
    person = through(dirty[: k + 1])
    np.testing.assert_array_equal(person.buffer.frames[-1].root_pos, dirty[k].root_pos)
    assert person.buffer.jumps == 1
    # Those before it stay where they were.
    assert abs(person.buffer.frames[-2].root_pos[0] - dirty[k - 1].root_pos[0]) < 0.02
    after = through(dirty).buffer
    assert after.jumps == 1 and after.tremble.late_s == LATE_S


def test_motion_that_begins_to_tremble_is_kept_back_gently() -> None:
    buffer, at = JitterBuffer(0.1), list[float]()
    for k in range(90):
        late = StreamTremble(20.0, None, LATE_S) if k >= 45 else StreamTremble()
        buffer.add(k * STEP, 100 + k * STEP, np.array([k * STEP, 0, 0.0]), np.eye(4)[:1], None, late)
        pose = buffer.read(100 + k * STEP)
        assert pose is not None
        at.append(pose.root_pos[0] - k * STEP)
    steps = np.diff(at[5:])
    assert at[40] == pytest.approx(-margin(0.1)) and at[-1] == pytest.approx(-margin(0.1) - LATE_S)
    assert steps.min() > -0.2 * STEP and steps.max() < 1e-9


def test_keypoints_are_smoothed_before_a_body_is_fitted(tracker: Tracker, walk: Clip) -> None:
    rng, loop, names = np.random.default_rng(0), Loop(walk), walk.skeleton.names
    fit = PointFit(Inbox(), tracker.example, tracker.humanoid.table)
    foot, truth = names.index("LeftFoot"), list[np.ndarray]()
    off, raw, held = list[float](), list[float](), set[float]()
    for k in range(240):
        now = k / 30
        truth.append(places(walk.skeleton, *loop(max(k - 90, 0))))
        points = truth[k] + 0.02 / np.sqrt(3) * rng.normal(size=truth[k].shape)
        raw.append(float(np.linalg.norm(points[foot] - truth[k][foot])))
        if k % 7 == 0:
            # One is not seen, also while the person stands.
            points[rng.integers(len(names))] = np.nan
        fit.fit(KeypointFrame("a", names, points, now, now))
        for arrived, packet in [p for line in fit.inbox.take().values() for p in line]:
            assert arrived == now and packet.tremble is not None
            if k > 150:
                held.add(round(packet.held_s, 4))
                assert packet.tremble.mm == pytest.approx(20.0, rel=0.25)
                at = places(packet.skeleton, packet.root_pos, packet.rot)
                there = truth[round(packet.time_s * 30)][foot]
                joint = packet.skeleton.names.index("LeftFoot")
                off.append(float(np.linalg.norm(at[joint] - there)))
    assert held == {round(STEP, 4)} and len(off) == 89
    assert np.mean(off) < 0.75 * np.mean(raw)


def test_refused_packets_leave_the_filter_alone(walk: Clip) -> None:
    dirty = stream(walk, 3.0, 0.03)
    inbox, person, bad = Inbox(Steady), Person("a", 0.1), dirty[40].rot.copy()
    bad[3] = np.nan
    for packet in dirty:
        assert inbox.offer(packet, packet.time_s)
        p = packet
        assert not inbox.offer(Packet("a", p.time_s + 0.01, p.skeleton, p.root_pos, bad), p.time_s)
        for arrived, came in inbox.take()["a"]:
            person.add(came, arrived, lambda *_: "no body")
    np.testing.assert_array_equal(person.buffer.frames[-1].rot, through(dirty).buffer.frames[-1].rot)
    assert inbox.refused["not finite"] == len(dirty)
