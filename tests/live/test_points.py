"""Keypoints of estimators: measured while people stand, fitted as they come, over TCP and UDP."""

from __future__ import annotations

import importlib.util
import json
import socket
import sys
import time
from collections.abc import Iterator
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from poise.env.reference import Poser
from poise.env.stream_goal import StreamGoal
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.kinematics.retargeting.passage import world_of
from poise.live.characters import TRACKS
from poise.live.points import PointFit
from poise.live.protocol import LiveConfig
from poise.live.session import Live
from poise.live.sockets import StreamDoor
from poise.live.sources import JsonStream, KeypointFrame
from poise.live.stream import Inbox, Packet
from poise.motion import Clip
from poise.motion.rotations import quat_rotate
from test_docs import ROOT, WALK

STEP = 1 / 30


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


@pytest.fixture(scope="module")
def walk() -> Clip:
    return read_clip(WALK)


def film(
    walk: Clip, rate: float, seconds: float, stands: float = 2.5
) -> Iterator[tuple[float, np.ndarray]]:
    """Times and points `(K, 3)` of a person that stands at first, and then walks faster and faster."""
    every = walk.positions()
    for k in range(round(seconds * rate)):
        walks = max(0.0, k / rate - stands)
        at = (0.5 * walks**2 if walks < 1.0 else walks - 0.5) * walk.fps % (walk.frames - 1)
        low = int(at)
        yield k / rate, every[low] + (at - low) * (every[low + 1] - every[low])


def joints(packet: Packet) -> dict[str, np.ndarray]:
    skeleton, world = packet.skeleton, world_of(packet.skeleton, packet.rot)
    out = [packet.root_pos]
    for j, parent in enumerate(skeleton.parents[1:], 1):
        out.append(out[parent] + quat_rotate(world[parent], skeleton.offsets[j]))
    return dict(zip(skeleton.names, out, strict=True))


def fitted(tracker: Tracker) -> PointFit:
    return PointFit(Inbox(), tracker.example, tracker.humanoid.table)


@pytest.mark.parametrize("rate", [10.0, 120.0])
def test_people_are_measured_and_fitted_at_any_rate(tracker: Tracker, walk: Clip, rate: float) -> None:
    fit, seen, off = fitted(tracker), 0, list[float]()
    names = walk.skeleton.names
    wanted = next(k for k, n in enumerate(names) if "leftfoot" in n.lower())
    for now, points in film(walk, rate, 3.2):
        fit.fit(KeypointFrame("a", names, points, now, now))
        if 1.0 < now < 1.9:
            assert 0.3 < fit.inbox.standing["a"] < 1.0
        for line in fit.inbox.take().values():
            for _, packet in line:
                seen += 1
                off.append(float(np.linalg.norm(joints(packet)["LeftFoot"] - points[wanted])))
    # Of 120 frames a second the newest are fitted.
    assert 8 < seen < 2.0 * 36 and not fit.inbox.standing and not fit.inbox.refused
    assert float(np.median(off)) < 0.03


def test_missing_points_leaps_and_other_keypoints(tracker: Tracker, walk: Clip) -> None:
    fit, names, rng = fitted(tracker), walk.skeleton.names, np.random.default_rng(0)
    took = {"torn": 0, "blind": 0, "back": 0}
    for now, points in film(walk, 30.0, 4.2):
        torn = points.copy()
        kind = "torn" if now < 2.8 else "blind" if now < 3.6 else "back"
        torn[rng.integers(len(names), size=2) if kind == "torn" and now > 2.2 else []] = np.nan
        if kind == "blind":
            torn[:] = np.nan
        fit.fit(KeypointFrame("a", names, torn + (8.0 if kind == "back" else 0.0), now, now))
        for line in fit.inbox.take().values():
            for _, packet in line:
                took[kind] += 1
                assert np.isfinite(packet.root_pos).all() and np.isfinite(packet.rot).all()
    assert took["torn"] > 15 and took["blind"] <= 16 and took["back"] > 5
    assert fit.inbox.refused["keypoints are missing"] > 5
    for k in range(70):
        fit.fit(KeypointFrame("b", ("x", "y"), np.ones((2, 3)), k / 30, k / 30))
    assert fit.inbox.refused["these keypoints show no body"] >= 1


def test_a_character_follows_keypoints_of_a_stream(tracker: Tracker, walk: Clip) -> None:
    live, tracked = Live(tracker, LiveConfig(), clock=lambda: 0.0), 0
    fit = PointFit(live.inbox, tracker.example, tracker.humanoid.table)
    fit.offer = fit.fit  # type: ignore[method-assign]
    stream = JsonStream(live.inbox, "", fit.offer)
    for now, points in film(walk, 30.0, 3.5):
        told = {"v": 1, "type": "keypoints", "person": "a", "time": now}
        if now == 0.0:
            told["names"] = list(walk.skeleton.names)
        rows = [[round(x, 4) for x in row] for row in points.tolist()]
        assert stream.receive(json.dumps({**told, "points": rows}), now) is None
        live.step(now)
        tracked += live.world.characters[0].doing == TRACKS and live.world.body(0).off_m < 0.3
        if 1.0 < now < 1.5:
            assert live.figures()["people"][0]["said"] == "stand still for 2 s"
    # The person is known after 2 s, and stands then as a walk begins, on one foot.
    assert tracked > 10 and live.people.of(0) is not None
    live.close()


@pytest.mark.parametrize(
    ("message", "why"),
    [
        ({"points": [[0, 0, 0]]}, "no names yet"),
        ({"names": []}, "no names"),
        ({"names": ["a", "a"]}, "no names"),
        ({"names": ["a"], "points": []}, "other keypoints"),
        ({"names": ["a"], "points": [[0, 0]]}, "no rows"),
        ({"names": ["a"], "points": [[0, 0, "x"]]}, "no number"),
        ({"names": ["a"], "points": [[0, 0, 1e5]]}, "too far away"),
        ({"names": ["a"], "points": [[0, 0, 0]], "confidence": [1, 1]}, "other keypoints"),
        ({"names": ["a"], "points": [[0, 0, 0]], "up": "X"}, "no vertical"),
    ],
)
def test_what_is_no_keypoints_is_refused(tracker: Tracker, message: dict, why: str) -> None:
    stream = JsonStream(Inbox(), "", fitted(tracker).offer)
    assert stream.receive(json.dumps({"v": 1, "type": "keypoints", **message}), 0.0) == why
    alone = JsonStream(Inbox())
    assert alone.receive('{"v": 1, "type": "keypoints"}', 0.0) == "no keypoints here"


class Door:
    """A door whose frames are kept."""

    def __init__(self, tracker: Tracker, token: str | None = None):
        self.fit, self.frames = fitted(tracker), list[KeypointFrame]()
        self.fit.offer = self.frames.append  # type: ignore[method-assign]
        self.door = StreamDoor("127.0.0.1", 0, self.fit.inbox, self.fit.offer, time.perf_counter, token)
        self.door.start()

    def until(self, frames: int) -> None:
        end = time.monotonic() + 20
        while len(self.frames) < frames and time.monotonic() < end:
            time.sleep(0.01)
        assert len(self.frames) == frames


LINE = json.dumps({"v": 1, "type": "keypoints", "names": ["a", "b"], "points": [[1, 2, 3], None]})


def test_tcp_and_udp_bring_keypoints(tracker: Tracker) -> None:
    there = Door(tracker)
    try:
        with socket.create_connection(("127.0.0.1", there.door.port), 5) as one:
            data = (LINE + "\n" + LINE + "\n").encode()
            one.sendall(data[:30])
            time.sleep(0.05)
            one.sendall(data[30:])
            there.until(2)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            one.sendto(LINE.encode(), ("127.0.0.1", there.door.port))
            there.until(3)
            one.sendto(b"\xff\x00", ("127.0.0.1", there.door.port))
        frame = there.frames[0]
        assert frame.names == ("a", "b") and frame.points[0].tolist() == [1, 2, 3]
        assert np.isnan(frame.points[1]).all()
        # Senders are people of their own.
        assert len({f.person for f in there.frames}) == 2
    finally:
        there.door.close()


def test_browsers_and_strangers_cannot_speak_to_the_door(tracker: Tracker) -> None:
    there = Door(tracker, "secret")
    try:
        for first in ("POST / HTTP/1.1\r\n\r\n" + LINE, LINE, LINE.replace("{", '{"token": 5, ', 1)):
            with socket.create_connection(("127.0.0.1", there.door.port), 5) as one:
                one.settimeout(20)
                one.sendall(first.encode() + b"\n")
                assert json.loads(one.recv(1000))["why"] == "no token"
        known = LINE.replace("{", '{"token": "secret", ', 1).encode()
        with socket.create_connection(("127.0.0.1", there.door.port), 5) as one:
            one.sendall(known + b"\n" + LINE.encode() + b"\n")
            there.until(2)
        with socket.create_connection(("127.0.0.1", there.door.port), 5) as one:
            one.settimeout(20)
            one.sendall(known + b"\n" + b"x" * 200_000)
            assert json.loads(one.recv(1000))["why"] == "too long"
    finally:
        there.door.close()


def webcam() -> ModuleType:
    spec = importlib.util.spec_from_file_location("webcam", ROOT / "examples/webcam.py")
    assert spec is not None and spec.loader is not None
    out = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(out)
    return out


def test_the_webcam_example_speaks_the_format(tracker: Tracker, walk: Clip) -> None:
    """With an estimator that sees the walk; nothing of the real one is imported."""
    script = webcam()
    assert "mediapipe" not in sys.modules and "cv2" not in sys.modules
    names, every = [n.lower() for n in walk.skeleton.names], walk.positions()
    at = {"hip": "upleg", "knee": "leg", "ankle": "foot", "shoulder": "arm", "elbow": "forearm",
          "wrist": "hand", "heel": "foot", "foot_index": "toebase"}  # fmt: skip

    def landmarks(points: np.ndarray) -> list[SimpleNamespace]:
        out = []
        hips = np.mean([points[names.index(f"{s}upleg")] for s in ("left", "right")], 0)
        for name in script.NAMES:
            side, _, part = name.partition("_")
            place = f"{side}{at.get(part, '')}"
            seen = place in names and part in at
            x, y, z = points[names.index(place)] - hips if seen else (0.0, 0.0, 0.0)
            # Poise's x ahead, y left, z up to the picture's right, down, away.
            out.append(SimpleNamespace(x=y, y=-z, z=-x, visibility=0.99 if seen else 0.1))
        return out

    there = Door(tracker)
    try:
        poses = [(landmarks(every[0]), k / 30) for k in range(70)]
        assert script.send(poses, "127.0.0.1", there.door.port) == 70
        there.until(70)
    finally:
        there.door.close()
    fit = fitted(tracker)
    for frame in there.frames:
        fit.fit(frame)
    (line,) = fit.inbox.take().values()
    last = joints(line[-1][1])
    assert last["LeftFoot"][2] < 0.15 and last["Hips"][2] > 0.6 and not fit.inbox.refused


def test_a_policy_of_keypoints_is_told_the_points_and_another_one_the_fit(walk: Clip) -> None:
    """The goal's places are those that the keypoints alone give; the fit goes on beside them."""
    # Told from 3.1 s on, standing at first: on some machines the policy loses the start of a walk.
    tracker = open_run("keypoints").tracker
    assert tracker.config.goal == "keypoints"
    live, inbox = Live(tracker, LiveConfig(buffer_s=0.0), clock=lambda: 0.0), Inbox()
    fit = PointFit(live.inbox, tracker.example, tracker.humanoid.table, tells_places=True)
    plain = PointFit(inbox, tracker.example, tracker.humanoid.table)
    names, apart, told, poser = walk.skeleton.names, list[float](), 0, Poser(tracker.humanoid)
    last: np.ndarray | None = None
    for now, points in film(walk, 30.0, 4.5, stands=3.5):
        fit.fit(KeypointFrame("a", names, points, now, now))
        plain.fit(KeypointFrame("a", names, points, now, now))
        (line,) = inbox.take().values() or ([],)
        assert all(p.places is None for _, p in line)
        waiting = live.inbox.take()
        for _, packet in waiting.get("a", []):
            assert packet.places is not None
            assert packet.places.shape == (len(tracker.humanoid.bodies), 3)
            # The same skeleton is fitted, whether or not the places are told.
            assert np.allclose(packet.rot, line[-1][1].rot, atol=1e-6)
            live.inbox.offer(packet, now)
            last = packet.places
        seen = live.step(now)
        person, goal = live.people.of(0), live.world.goal
        if seen is None or seen.own[0] is None or person is None or person.onto is None or last is None:
            continue
        newest = goal.layout.unpacked(goal.packs[:, int(goal.count[0] - 1) % goal.size])
        pose = person.read(now + STEP)
        assert pose is not None and pose.places is not None
        places = person.onto.where.points(pose.places)
        assert np.allclose(newest.pos[0].numpy(), places, atol=1e-4)
        # What the coordinates would have told is another thing, by centimetres.
        made = goal.coordinates(torch.tensor([0]), goal.count - 1)
        fk = poser.live(*made).pos[0].numpy()
        apart.append(float(np.linalg.norm(fk - places, axis=-1).mean()))
        told += 1
    assert told > 10
    assert 0.0005 < float(np.median(apart)) < 0.1
    live.close()


def test_a_stream_goal_takes_places(tracker: Tracker) -> None:
    goal = StreamGoal(tracker.humanoid, 30.0, 2)
    assert tracker.recovery_clips is not None
    ease, bodies = tracker.recovery_clips.ease, len(tracker.humanoid.bodies)
    goal.push(ease)
    goal.reset(torch.arange(2))
    places = torch.full((2, bodies, 3), torch.nan)
    places[1] = torch.randn(bodies, 3, generator=torch.Generator().manual_seed(0))
    goal.push(ease.expand(2, -1), places=places)
    moved = places + 0.01
    goal.push(ease.expand(2, -1), places=moved)
    pose = goal.layout.unpacked(goal.packed(torch.arange(2), goal.count - 1))
    assert torch.equal(pose.pos[1], moved[1]) and torch.allclose(
        pose.linvel[1], torch.full((bodies, 3), 0.3), atol=1e-4
    )
    assert bool(pose.pos[0].isfinite().all()) and float(pose.linvel[0].abs().max()) < 1e-4
    # A frame without places is told by its coordinates again.
    goal.push(ease.expand(2, -1))
    pose = goal.layout.unpacked(goal.packed(torch.arange(2), goal.count - 1))
    assert torch.allclose(pose.pos[0], pose.pos[1], atol=1e-6)
