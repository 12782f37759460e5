"""Keypoints as they come: against the offline way, with gaps, other rates, no look ahead."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from poise.body import BodyTable, generate_table
from poise.formats import read_clip
from poise.formats.point_fit import fit_clip
from poise.formats.point_raw import assemble_points
from poise.formats.point_tables import trc_points
from poise.formats.raw import ReadOptions as Options
from poise.kinematics import RetargetConfig, retarget
from poise.kinematics.ground import fit_heights
from poise.kinematics.retargeting.keypoint_goal import KeypointStream, PointBody, StreamConfig
from poise.motion import Clip, resample, trim
from poise.motion.keypoints import Keypoints
from refusals import refused
from toy_human import swing

RATE = 30.0


def points_of(clip: Clip) -> Keypoints:
    return Keypoints(clip.skeleton.names, clip.positions(), clip.fps, clip.name)


def bodies(clip: Clip, table: BodyTable) -> np.ndarray:
    """Positions of the bodies, the whole lifted onto z = 0."""
    pos, quat = (x[:, [r.joint for r in table.rows]] for x in clip.world())
    lift = fit_heights(table, pos, quat, clip.fps).lift_m
    return pos + np.array([0.0, 0.0, lift])


def offline(points: Keypoints, onto: Clip, table: BodyTable, contacts: bool) -> np.ndarray:
    config = RetargetConfig(contacts=contacts, clear=contacts)
    return bodies(retarget(fit_clip(points), onto, config=config)[0], table)


@pytest.fixture(scope="module")
def toy() -> tuple[Keypoints, Clip, BodyTable, PointBody]:
    """A performer of another size than the humanoid, and the two brought together."""
    onto = swing(1.0, scale=0.9)
    table = generate_table(onto.skeleton, None, [onto])
    points = points_of(swing(2.0, speed=0.8, bend=0.6))
    return points, onto, table, PointBody.calibrate(points, onto, table)


def test_as_the_offline_way(toy) -> None:
    points, onto, table, body = toy
    frames = list(KeypointStream(body, RATE).follow(points))
    pos = np.stack([f.pos for f in frames])
    assert len(frames) == points.frames
    np.testing.assert_allclose([f.time_s for f in frames], np.arange(points.frames) / RATE)
    # The same but for contacts, which are not held, and lengths, which get fewer rounds.
    assert np.abs(pos - offline(points, onto, table, False)).max() < 1e-3
    apart = np.linalg.norm(pos - offline(points, onto, table, True), axis=-1)
    assert apart.mean() < 0.015 and apart.max() < 0.1


def test_bones_are_the_humanoids(toy) -> None:
    points, onto, table, body = toy
    pos = body.solve(points.positions)
    names = [r.name for r in table.rows]
    for a, b in (("LeftUpLeg", "LeftLeg"), ("RightArm", "RightForeArm")):
        length = np.linalg.norm(pos[:, names.index(b)] - pos[:, names.index(a)], axis=-1)
        want = np.linalg.norm(onto.skeleton.offsets[onto.skeleton.index(b)])
        np.testing.assert_allclose(length, want, atol=1e-9)


def test_a_recording_comes_as_its_frames_do(toy) -> None:
    points, *_, body = toy
    live = KeypointStream(body, RATE)
    pushed = [g for t in range(20) for g in live.push(points.positions[t], t / RATE)] + live.finish()
    first = points.replaced(positions=points.positions[:20])
    told = list(KeypointStream(body, RATE).follow(first))
    assert [g.time_s for g in pushed] == [g.time_s for g in told]
    for a, b in zip(pushed, told, strict=True):
        np.testing.assert_allclose(a.pos, b.pos, atol=1e-12)
        np.testing.assert_allclose(a.linvel, b.linvel, atol=1e-9)


def test_nothing_is_known_of_the_future(toy) -> None:
    points, *_, body = toy
    other = points.positions.copy()
    other[12:] += 5.0
    for lookahead in (0, 1):
        config = StreamConfig(lookahead=lookahead, smooth_hz=3.0, max_speed=1e9)
        streams = KeypointStream(body, RATE, config), KeypointStream(body, RATE, config)
        assert streams[0].latency_s == lookahead / RATE
        for t in range(15):
            a, b = (
                s.push(p[t], t / RATE) for s, p in zip(streams, (points.positions, other), strict=True)
            )
            assert len(a) == len(b) == (0 if t < lookahead else 1)
            for x, y in zip(a, b, strict=True):
                assert x.time_s == pytest.approx((t - lookahead) / RATE)
                # The changed frames are not in the goals that were given before they came.
                assert (np.abs(x.pos - y.pos).max() < 1e-12) == (t - lookahead < 12)
                assert (np.abs(x.linvel - y.linvel).max() < 1e-9) == (t < 12)


def test_velocities_are_differences(toy) -> None:
    points, *_, body = toy
    pos = body.solve(points.positions)
    ahead = np.stack([g.linvel for g in KeypointStream(body, RATE).follow(points)])
    np.testing.assert_allclose(ahead, np.gradient(pos, axis=0) * RATE, atol=1e-9)
    stream = KeypointStream(body, RATE, StreamConfig(lookahead=0))
    behind = np.stack([g.linvel for g in stream.follow(points)])
    np.testing.assert_allclose(behind[1:], np.diff(pos, axis=0) * RATE, atol=1e-9)


def test_another_rate_of_the_source(toy) -> None:
    *_, body = toy
    clip = swing(2.0, speed=0.8, bend=0.6)
    slow = np.stack([g.pos for g in KeypointStream(body, RATE).follow(points_of(clip))])
    for fps in (60.0, 25.0):
        goals = list(KeypointStream(body, RATE).follow(points_of(swing(2.0, fps, 0.8, 0.6))))
        np.testing.assert_allclose([g.time_s for g in goals], np.arange(len(goals)) / RATE, atol=1e-9)
        # The path is 0.8 m/s from the first frame on, so a coarser one lags by part of a frame.
        apart = np.linalg.norm(np.stack([g.pos for g in goals]) - slow[: len(goals)], axis=-1)
        assert len(goals) == 61 and apart.max() < 0.03


def test_gaps_travel_along(toy) -> None:
    points, *_, body = toy
    pos = points.positions.copy()
    wrist = points.names.index("LeftForeArm")
    pos[20:26, wrist] = np.nan
    pos[40:43] = np.nan
    goals = list(KeypointStream(body, RATE).follow(points.replaced(positions=pos)))
    whole = body.solve(points.positions)
    apart = np.linalg.norm(np.stack([g.pos for g in goals]) - whole, axis=-1)
    assert apart[:20].max() < 1e-9 and np.isfinite(apart).all()
    # A forearm's end in six frames, the whole body in three of 0.8 m/s.
    assert apart[20:26].max() < 0.12 and apart[40:43].max() < 0.15
    stale = np.array([g.stale_s for g in goals])
    assert stale[19] == 0.0 and stale[25] == pytest.approx(6 / RATE) and stale[42] == pytest.approx(0.1)
    # Nothing is given before all were seen.
    pos[:5, wrist] = np.nan
    late = list(KeypointStream(body, RATE).follow(points.replaced(positions=pos)))
    assert late[0].time_s == pytest.approx(5 / RATE) and len(late) == len(goals) - 5


def test_a_keypoint_that_jumps_is_missing(toy) -> None:
    points, *_, body = toy
    pos = points.positions.copy()
    pos[10, points.names.index("RightHand")] += 3.0
    goals = list(KeypointStream(body, RATE).follow(points.replaced(positions=pos)))
    apart = np.linalg.norm(np.stack([g.pos for g in goals]) - body.solve(points.positions), axis=-1)
    assert apart.max() < 0.05 and goals[10].stale_s > 0


def test_what_cannot_be_streamed(toy) -> None:
    points, onto, table, body = toy
    stream = KeypointStream(body, RATE)
    with refused("wrong-shape", says="(19, 3)"):
        stream.push(points.positions[0, :3], 0.0)
    stream.push(points.positions[0], 1.0)
    with refused("times-not-rising"):
        stream.push(points.positions[1], 1.0)
    renamed = replace(points, names=tuple(f"x{n}" for n in points.names))
    with refused("keypoints-differ"):
        list(KeypointStream(body, RATE).follow(renamed))
    markers = replace(points, names=tuple(f"M{k}" for k in range(len(points.names))))
    with refused("keypoint-missing"):
        PointBody.calibrate(markers, onto, table)
    for bad in ({"lookahead": 2}, {"smooth_hz": -1.0}, {"max_speed": 0.0}):
        with refused("out-of-range"):
            StreamConfig(**bad)
    with refused("out-of-range"):
        KeypointStream(body, 0.0)


def test_a_real_clip_and_real_keypoints(data_dir) -> None:
    onto = read_clip(data_dir / "cmu_amc/02/02_01.amc")
    table = generate_table(onto.skeleton, None, [onto])
    dance = trim(resample(read_clip(data_dir / "cmu_bvh/ad/dance001.bvh"), RATE), 0, 120)
    points = points_of(dance)
    body = PointBody.calibrate(points, onto, table)
    pos = np.stack([g.pos for g in KeypointStream(body, RATE).follow(points)])
    apart = np.linalg.norm(pos - offline(points, onto, table, True), axis=-1)
    assert apart.mean() < 0.01 and apart.max() < 0.06
    # The same dance retargeted by its rotations: joints are defined otherwise, most in the trunk.
    direct = bodies(retarget(dance, onto)[0], table)
    assert np.linalg.norm(pos - direct, axis=-1).mean() < 0.06

    path = data_dir / "noisy/pose2sim/single/S00_P00_T01_BalancingTrial_0-100.trc"
    raw = assemble_points(trc_points(path), Options())
    body = PointBody.calibrate(raw, onto, table)
    goals = list(KeypointStream(body, RATE, StreamConfig(smooth_hz=3.0)).follow(raw))
    assert len(goals) == 50
    assert np.isfinite([g.pos for g in goals]).all() and np.abs([g.linvel for g in goals]).max() < 6.0
    low = min(float(g.pos[:, 2].min()) for g in goals)
    assert -0.05 < low < 0.2
