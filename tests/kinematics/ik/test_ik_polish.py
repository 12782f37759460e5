"""mink brings joints onto their targets where the analytic answer cannot."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from paper_humanoid import body_points

import toy_human
from poise.body import generate_table, make_humanoid
from poise.kinematics import IkBody, Kinematics, clip_ik, polish
from poise.motion.rotations import quat_to_matrix
from refusals import refused

pytest.importorskip("mink")


@pytest.fixture(scope="module")
def humanoid():
    skeleton = toy_human.human()
    return make_humanoid(skeleton, generate_table(skeleton))


def points(humanoid, q: np.ndarray) -> dict[str, np.ndarray]:
    body = IkBody.of(humanoid)
    state = Kinematics(humanoid.table)(q)
    at = body_points(body, state.pos, quat_to_matrix(state.quat))
    return {n: at[:, i] for i, n in enumerate(body.points)}


def test_feet_and_toes_reach_targets_that_the_motion_misses(humanoid):
    q = clip_ik(toy_human.swing(seconds=0.5), humanoid)
    here = points(humanoid, q)
    targets = {n: here[n] + [0.02, 0.0, 0.03] for n in ("LeftFoot", "LeftToe")}
    got = polish(q, targets, humanoid)
    assert got.before_mm == pytest.approx(36.06, abs=0.01)
    assert got.after_mm < 0.2
    there = points(humanoid, got.qpos)
    for name, goal in targets.items():
        assert np.linalg.norm(there[name] - goal, axis=-1).max() < 5e-4
    # The other leg and the arms stay nearly as they were.
    assert np.linalg.norm(there["RightHand"] - here["RightHand"], axis=-1).max() < 0.01
    assert 0.1 < got.moved_deg < 60.0
    assert np.abs(np.diff(got.qpos[:, 7:], axis=0)).max() < 0.3


def test_targets_that_are_met_and_free_frames_change_nothing(humanoid):
    q = clip_ik(toy_human.swing(seconds=0.3), humanoid)
    here = points(humanoid, q)
    goal = here["LeftHand"] + 0.05
    goal[:5] = np.nan
    got = polish(q, {"LeftHand": goal, "RightFoot": here["RightFoot"]}, humanoid)
    np.testing.assert_allclose(got.qpos[:5], q[:5], atol=1e-12)
    assert np.abs(got.qpos[5:] - q[5:]).max() > 0.01


def test_a_target_out_of_reach_brings_no_worse(humanoid):
    q = clip_ik(toy_human.swing(seconds=0.2), humanoid)
    far = points(humanoid, q)["LeftHand"] + [0.0, 1.0, 1.0]
    keep = points(humanoid, q)["Hips"]
    got = polish(q, {"LeftHand": far, "Hips": keep}, humanoid, steps=5)
    assert got.after_mm < got.before_mm
    assert np.isfinite(got.qpos).all()


def test_mistakes_are_told_in_a_sentence(humanoid, monkeypatch):
    q = clip_ik(toy_human.swing(seconds=0.2), humanoid)
    with refused("unknown-body", says=("LeftFot", "LeftFoot")):
        polish(q, {"LeftFot": np.zeros((len(q), 3))}, humanoid)
    with refused("wrong-shape"):
        polish(q, {"LeftFoot": np.zeros((1, 3))}, humanoid)
    monkeypatch.setitem(sys.modules, "mink", None)
    with refused("extra-missing", says="poise-motion[ik]"):
        polish(q, {"LeftFoot": np.zeros((len(q), 3))}, humanoid)
