"""Ground fit by known amounts, and contact labels of an authored step."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from poise.body import generate_table
from poise.kin import Kinematics, clip_to_qpos, contact_labels, fit_ground, fit_humanoid, lowest_height
from toy_human import human, swing


def lowest(qpos: np.ndarray, table) -> np.ndarray:
    state = Kinematics(table)(torch.tensor(qpos))
    return lowest_height(table, state.pos, state.quat).min(-1).values.numpy()


@pytest.fixture(scope="module")
def still():
    """A still stance whose lowest point is at z = 0 exactly, and its table."""
    table = generate_table(human())
    qpos = np.repeat(clip_to_qpos(swing(), table)[:1], 60, 0)
    qpos[:, 2] -= lowest(qpos, table)[0]
    return qpos, table


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
    assert f"Lifted by {-offset * 1000 + 1e-9:+.0f} mm" in fit.sentence()


def test_a_flight_stays_a_flight(still):
    qpos, table = still
    jump = qpos.copy()
    jump[20:40, 2] += 0.5 * np.sin(np.linspace(0, np.pi, 20))
    out, fit = fit_ground(jump, table, 30.0)
    np.testing.assert_allclose(out, jump, atol=1e-9)
    assert fit.clear_m.max() == 0.0


def test_a_frame_that_sinks_is_lifted_smoothly(still):
    qpos, table = still
    dip = qpos.copy()
    dip[30, 2] -= 0.04
    before = dip.copy()
    out, fit = fit_ground(dip, table, 30.0)
    assert np.array_equal(dip, before), "The argument must not change."
    assert lowest(out, table).min() > -1e-9 and fit.before_m == pytest.approx(-0.04)
    assert abs(fit.lift_m) < 1e-9 and 0.039 < fit.clear_m.max() <= 0.0401
    # It rises and falls over several frames, and is gone half a second away.
    assert np.abs(np.diff(fit.clear_m)).max() < 0.02
    assert fit.clear_m[:15].max() == 0.0 and fit.clear_m[45:].max() == 0.0


def test_a_cyclic_clip_is_cleared_across_its_seam(still):
    qpos, table = still
    dip = qpos.copy()
    dip[0, 2] -= 0.04
    _, fit = fit_ground(dip, table, 30.0, cyclic=True)
    assert fit.clear_m[-1] > 0.02 and fit.clear_m[30] == 0.0


def test_a_few_bad_frames_do_not_lift_the_clip(still):
    qpos, table = still
    bad = qpos.copy()
    bad[:4, 2] -= 0.3
    _, fit = fit_ground(bad, table, 30.0)
    assert abs(fit.lift_m) < 1e-9


def test_fitted_motions_never_sink():
    humanoid, motions, report = fit_humanoid(swing(speed=1.0))
    # What sinks in by less than a tenth of a millimetre stays.
    assert lowest(motions[0], humanoid.table).min() > -1e-4
    assert report.ground[0].after_m > -1e-4
    sentences = report.sentences()
    assert any("mm to stand on the floor" in s for s in sentences)
    assert any("0.0 mm from the clip's" in s for s in sentences)


def step_path(fps: float = 60.0) -> torch.Tensor:
    """One foot: half a second down, a step of 0.6 m and 0.2 m high in half a second, half down."""
    t = torch.linspace(0, 1, round(fps / 2), dtype=torch.float64)
    swing_ = torch.stack(
        (
            0.6 * (t - torch.sin(2 * np.pi * t) / (2 * np.pi)),
            0 * t,
            0.1 * (1 - torch.cos(2 * np.pi * t)),
        ),
        -1,
    )
    down = torch.zeros(round(fps / 2), 3, dtype=torch.float64)
    return torch.cat((down, swing_, down + torch.tensor([0.6, 0.0, 0.0])))


def test_contacts_of_an_authored_step():
    path = step_path()
    label = contact_labels(path[:, None], 60.0)[:, 0]
    assert label[:30].all() and label[60:].all()
    # In the air for all but a few slow, low frames at both ends.
    assert not label[36:54].any() and int(label[30:60].sum()) <= 8
    # Four switches at most: down, air, down.
    assert int((label[1:] != label[:-1]).sum()) == 2


def test_contacts_need_low_and_slow():
    still = torch.zeros(20, 1, 3)
    assert contact_labels(still, 30.0).all()
    assert not contact_labels(still + torch.tensor([0, 0, 0.2]), 30.0).any()
    assert contact_labels(still + torch.tensor([0, 0, 0.2]), 30.0, ground=0.2).all()
    slide = still.clone()
    slide[:, 0, 0] = torch.arange(20) / 30.0 * 0.5
    assert not contact_labels(slide, 30.0).any() and contact_labels(slide, 30.0, speed=0.6).all()


def test_single_frames_are_closed():
    path = torch.zeros(20, 2, 3)
    path[7, 0, 2] = 0.06  # One frame out of contact.
    path[:, 1, 2] = 0.06
    path[9, 1, 2] = 0.04  # One frame in contact.
    label = contact_labels(path, 1.0)
    assert label[:, 0].all() and not label[:, 1].any()
