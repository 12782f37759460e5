"""Ground fit by known amounts, and contact labels of an authored step."""

from __future__ import annotations

import numpy as np
import pytest

from poise.body import generate_table
from poise.formats import read_clip
from poise.kinematics import (
    Kinematics,
    clip_to_qpos,
    contact_labels,
    fit_ground,
    fit_humanoid,
    lowest_height,
)
from poise.kinematics.feet import stance_heights
from poise.kinematics.ground import SINK_M
from poise.motion import resample
from toy_human import human, swing


def lowest(qpos: np.ndarray, table) -> np.ndarray:
    state = Kinematics(table)(qpos)
    return lowest_height(table, state.pos, state.quat).min(-1)


@pytest.fixture(scope="module")
def still():
    """A still stance with level soles at z = 0 exactly, and its table."""
    table = generate_table(human())
    qpos = np.repeat(clip_to_qpos(swing(), table)[:1], 60, 0)
    qpos[:, 7:] = 0.0
    qpos[:, 2] -= lowest(qpos, table)[0]
    return qpos, table


def stances(qpos: np.ndarray, table, fps: float = 30.0) -> np.ndarray:
    state = Kinematics(table)(qpos)
    return stance_heights(table, state.pos, state.quat, fps)


@pytest.mark.parametrize("offset", [-0.31, -0.02, 0.0, 0.004, 0.25])
def test_sunken_and_floating_clips_are_set_down(still, offset):
    qpos, table = still
    moved = qpos.copy()
    moved[:, 2] += offset
    out, fit = fit_ground(moved, table, 30.0)
    np.testing.assert_allclose(out, qpos, atol=1e-9)
    assert fit.lift_m == pytest.approx(-offset, abs=1e-9)
    assert fit.before_m == pytest.approx(offset, abs=1e-9) and fit.after_m == pytest.approx(0, abs=1e-9)
    assert fit.clear_m.max() == 0.0
    assert f"Lifted by {round(-offset * 1000):+d} mm to stand" in fit.sentence()


def test_a_flight_stays_a_flight(still):
    qpos, table = still
    jump = qpos.copy()
    jump[20:40, 2] += 0.5 * np.sin(np.linspace(0, np.pi, 20))
    out, fit = fit_ground(jump, table, 30.0)
    np.testing.assert_allclose(out, jump, atol=1e-9)
    assert fit.clear_m.max() == 0.0


@pytest.mark.parametrize("offset", [-3.0, -0.07, 0.015, 0.5])
@pytest.mark.parametrize("cyclic", [False, True])
def test_the_height_that_a_clip_came_at_does_not_matter(offset, cyclic):
    table = generate_table(human())
    qpos = clip_to_qpos(swing(speed=1.0), table)
    qpos[10:13, 2] -= 0.07
    out, fit = fit_ground(qpos, table, 30.0, cyclic)
    moved = qpos.copy()
    moved[:, 2] += offset
    again, other = fit_ground(moved, table, 30.0, cyclic)
    np.testing.assert_allclose(again, out, atol=1e-9)
    np.testing.assert_allclose(other.clear_m, fit.clear_m, atol=1e-9)
    assert other.lift_m == pytest.approx(fit.lift_m - offset, abs=1e-9)
    assert other.after_m == pytest.approx(fit.after_m, abs=1e-9)


def test_what_sinks_by_less_than_the_limit_stays(still):
    qpos, table = still
    dip = qpos.copy()
    dip[30, 2] -= 0.019
    out, fit = fit_ground(dip, table, 30.0)
    np.testing.assert_allclose(out, dip, atol=1e-9)
    assert fit.clear_m.max() == 0.0 and fit.after_m == pytest.approx(-0.019)


def test_a_frame_that_sinks_is_lifted_smoothly(still):
    qpos, table = still
    dip = qpos.copy()
    dip[30, 2] -= SINK_M + 0.04
    before = dip.copy()
    out, fit = fit_ground(dip, table, 30.0)
    assert np.array_equal(dip, before), "The argument must not change."
    assert lowest(out, table).min() == pytest.approx(-SINK_M) and fit.after_m == pytest.approx(-SINK_M)
    assert fit.before_m == pytest.approx(-SINK_M - 0.04)
    assert abs(fit.lift_m) < 1e-9 and 0.039 < fit.clear_m.max() <= 0.0401
    # It rises and falls over several frames, and is gone half a second away.
    assert np.abs(np.diff(fit.clear_m)).max() < 0.02
    assert fit.clear_m[:15].max() == 0.0 and fit.clear_m[45:].max() == 0.0


@pytest.mark.parametrize("frame", [0, 59])
def test_a_cyclic_clip_is_cleared_across_its_seam(still, frame):
    qpos, table = still
    dip = qpos.copy()
    dip[frame, 2] -= SINK_M + 0.04
    _, fit = fit_ground(dip, table, 30.0, cyclic=True)
    # Both ends are one moment: the lift is the same there and falls alike to both sides.
    assert fit.clear_m[-1] == fit.clear_m[0] > 0.039 and fit.clear_m[30] == 0.0
    np.testing.assert_allclose(fit.clear_m, fit.clear_m[::-1], atol=1e-12)


def test_only_flat_and_slow_feet_stand(still):
    qpos, table = still
    np.testing.assert_allclose(stances(qpos, table), np.zeros(120), atol=1e-9)
    slide, tilt, air = qpos.copy(), qpos.copy(), qpos.copy()
    slide[:, 0] = np.arange(60) / 30.0 * 0.5
    assert not len(stances(slide, table))
    tilt[:, 3:7] = [np.cos(0.2), 0.0, np.sin(0.2), 0.0]
    assert not len(stances(tilt, table))
    # A level rest in the air is told by its height.
    air[40:, 2] += 0.3
    assert np.abs(stances(air, table)).max() < 1e-9 and len(stances(air, table)) >= 78


def test_where_no_foot_stands_the_lowest_points_are_set_down(still):
    qpos, table = still
    slide = qpos.copy()
    slide[:, 0] = np.arange(60) / 30.0 * 2.0
    slide[:, 2] += 0.2
    slide[:6, 2] += 0.1
    _, fit = fit_ground(slide, table, 30.0)
    assert fit.lift_m == pytest.approx(-0.2, abs=1e-9) and fit.clear_m.max() == 0.0


def test_badly_solved_feet_do_not_drag_the_clip_down():
    # A tall toy on tiptoe: its soles are within 20 degrees of level and over 4 cm up in the middle.
    table = generate_table(human(1.2))
    tiptoe = np.repeat(clip_to_qpos(swing(scale=1.2), table)[:1], 60, 0)
    tiptoe[:, 7:] = 0.0
    tiptoe[:, 3:7] = [np.cos(0.165), 0.0, np.sin(0.165), 0.0]
    low = lowest(tiptoe, table)
    middle = np.median(stances(tiptoe, table)) - low[0]
    assert middle > 2 * SINK_M
    _, fit = fit_ground(tiptoe, table, 30.0)
    assert fit.lift_m == pytest.approx(-low[0] - 2 * SINK_M) and fit.after_m == pytest.approx(-SINK_M)


@pytest.mark.parametrize("name", ["cmu_amc/02/02_01.amc", "deepmimic_txt/humanoid3d_walk.txt"])
def test_real_walks_stand_on_the_floor(data_dir, name):
    clip = resample(read_clip(data_dir / name), 30.0)
    table = generate_table(clip.skeleton, None, [clip])
    out, fit = fit_ground(clip_to_qpos(clip, table), table, 30.0)
    assert abs(float(np.median(stances(out, table)))) < 0.015
    assert lowest(out, table).min() > -SINK_M - 1e-4 and fit.after_m < 0.0


def test_a_few_bad_frames_do_not_lift_the_clip(still):
    qpos, table = still
    bad = qpos.copy()
    bad[:4, 2] -= 0.3
    _, fit = fit_ground(bad, table, 30.0)
    assert abs(fit.lift_m) < 1e-9


def test_fitted_motions_sink_no_deeper_than_the_limit():
    humanoid, motions, report = fit_humanoid(swing(speed=1.0))
    # An excess of less than a tenth of a millimetre stays.
    assert lowest(motions[0], humanoid.table).min() > -SINK_M - 1e-4
    assert report.clips[0].ground.after_m > -SINK_M - 1e-4
    sentences = report.sentences()
    assert any("mm to stand on the floor" in s for s in sentences)
    assert any("0.0 mm from the clip's" in s for s in sentences)


def step_path(fps: float = 60.0) -> np.ndarray:
    """One foot: half a second down, a step of 0.6 m and 0.2 m high in half a second, half down."""
    t = np.linspace(0, 1, round(fps / 2))
    swing_ = np.stack(
        (
            0.6 * (t - np.sin(2 * np.pi * t) / (2 * np.pi)),
            0 * t,
            0.1 * (1 - np.cos(2 * np.pi * t)),
        ),
        -1,
    )
    down = np.zeros((round(fps / 2), 3))
    return np.concatenate((down, swing_, down + np.array([0.6, 0.0, 0.0])))


def test_contacts_of_an_authored_step():
    path = step_path()
    label = contact_labels(path[:, None], 60.0)[:, 0]
    assert label[:30].all() and label[60:].all()
    # In the air for all but a few slow, low frames at both ends.
    assert not label[36:54].any() and int(label[30:60].sum()) <= 8
    # Four switches at most: down, air, down.
    assert int((label[1:] != label[:-1]).sum()) == 2


def test_contacts_need_low_and_slow():
    still = np.zeros((20, 1, 3))
    assert contact_labels(still, 30.0).all()
    assert not contact_labels(still + np.array([0, 0, 0.2]), 30.0).any()
    assert contact_labels(still + np.array([0, 0, 0.2]), 30.0, ground=0.2).all()
    slide = still.copy()
    slide[:, 0, 0] = np.arange(20) / 30.0 * 0.5
    assert not contact_labels(slide, 30.0).any() and contact_labels(slide, 30.0, speed=0.6).all()


def test_single_frames_are_closed():
    path = np.zeros((20, 2, 3))
    path[7, 0, 2] = 0.06  # One frame out of contact.
    path[:, 1, 2] = 0.06
    path[9, 1, 2] = 0.04  # One frame in contact.
    label = contact_labels(path, 1.0)
    assert label[:, 0].all() and not label[:, 1].any()
