"""Cycles closed: the end is the start one cycle later, what a cycle adds stays."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from poise.body import generate_table
from poise.env import Reference
from poise.formats import read_clip
from poise.kinematics import (
    clip_to_qpos,
    close_cycle,
    cycle_step,
    cycle_velocity,
    fit_humanoid,
    qpos_velocity,
)
from poise.kinematics.loops import join_cycle
from poise.motion import ClipLibrary
from poise.motion.rotations import heading_quat, quat_angle, quat_conj, quat_mul, rotvec_to_quat
from poise.motion.vectors import norm
from toy_human import human, swing


def apart(a: np.ndarray, b: np.ndarray) -> float:
    return float(quat_angle(quat_mul(quat_conj(a), b)).max())


def heading(quat: np.ndarray) -> np.ndarray:
    return heading_quat(quat)


def missed_end(qpos: np.ndarray) -> float:
    """The largest difference between the last frame and the first one carried on by the cycle's step."""
    turn, travel = cycle_step(qpos)
    first, last = qpos[0], qpos[-1]
    tilt = apart(quat_mul(turn, first[3:7]), last[3:7])
    assert float(travel[2]) == 0.0
    return max(tilt, float(np.abs(last[7:] - first[7:]).max()), abs(float(last[2] - first[2])))


@pytest.fixture(scope="module")
def whole() -> np.ndarray:
    """An authored cycle that walks a bend and closes."""
    return clip_to_qpos(swing(1.0, speed=1.2, bend=0.7, cyclic=True), generate_table(human()))


@pytest.fixture(scope="module")
def opened(whole) -> np.ndarray:
    """The same with a drift: 0.4 rad in a hinge, 3 cm of height, 0.2 rad of tilt."""
    drift = np.linspace(0.0, 1.0, len(whole))[:, None]
    out = whole.copy()
    out[:, 9] += 0.4 * drift[:, 0]
    out[:, 2] += 0.03 * drift[:, 0]
    lean = rotvec_to_quat(drift * [0.12, -0.16, 0.0])
    out[:, 3:7] = quat_mul(out[:, 3:7], lean)
    return out


def test_a_closed_cycle_stays_as_it_is(whole):
    closed, gap_deg = close_cycle(whole)
    np.testing.assert_allclose(closed, whole, atol=1e-9)
    assert gap_deg == pytest.approx(0.0, abs=1e-6)


def test_a_linear_drift_is_taken_out(whole, opened):
    before = opened.copy()
    closed, gap_deg = close_cycle(opened)
    assert np.array_equal(opened, before), "The argument must not change."
    assert gap_deg == pytest.approx(math.degrees(0.4))
    assert missed_end(opened) > 0.39 and missed_end(closed) < 1e-6
    np.testing.assert_allclose(closed[:, [2, 9]], whole[:, [2, 9]], atol=1e-9)
    # The authored cycle comes back, the tilt up to the little heading that the drift itself made.
    assert apart(closed[:, 3:7], whole[:, 3:7]) < 0.02
    np.testing.assert_array_equal(closed[0], opened[0])
    np.testing.assert_array_equal(closed[:, :2], opened[:, :2])
    assert apart(heading(closed[-1:, 3:7]), heading(opened[-1:, 3:7])) < 1e-7
    assert np.abs(np.linalg.norm(closed[:, 3:7], axis=1) - 1).max() < 1e-12


def test_hinges_close_modulo_a_turn(whole):
    turning = whole.copy()
    turning[:, 12] = np.linspace(0.3, 0.3 + 2 * math.pi - 0.1, len(whole))
    closed, gap_deg = close_cycle(turning)
    assert closed[-1, 12] - closed[0, 12] == pytest.approx(2 * math.pi)
    assert gap_deg == pytest.approx(math.degrees(0.1))
    names = [f"h{i}" for i in range(whole.shape[1] - 7)]
    same, cycle = join_cycle(turning, names)
    assert np.array_equal(same, turning) and cycle.open_hinge == "h5"
    assert "Not repeated" in cycle.sentence() and "h5 ends 354 degrees" in cycle.sentence()
    joined, cycle = join_cycle(whole, names)
    assert cycle.open_hinge is None and missed_end(joined) < 1e-6
    assert cycle.sentence().startswith("The cycle did not close by 0.0 degrees")


def test_a_somersault_closes():
    # The root turns once about its side axis: its tilt comes back although its quaternion is negated.
    qpos = np.zeros((40, 9))
    angle = np.linspace(0.0, 2 * math.pi + 0.1, 40)
    qpos[:, 3], qpos[:, 5] = np.cos(angle / 2), np.sin(angle / 2)
    closed, gap_deg = close_cycle(qpos)
    assert gap_deg == pytest.approx(math.degrees(0.1)) and missed_end(closed) < 1e-6
    step = quat_mul(quat_conj(closed[:-1, 3:7]), closed[1:, 3:7])
    np.testing.assert_allclose(quat_angle(step), 2 * math.pi / 39, atol=1e-9)


def test_velocities_reach_across_the_seam(whole):
    closed, _ = close_cycle(whole)
    speed = cycle_velocity(closed, 30.0)
    np.testing.assert_allclose(speed[1:-1], qpos_velocity(closed, 30.0)[1:-1], atol=1e-9)
    # Both ends are one moment: the same in the root's own frame, hinges and turn alike.
    np.testing.assert_allclose(speed[0, 3:], speed[-1, 3:], atol=1e-9)
    np.testing.assert_allclose(speed[0, 7], (closed[1, 8] - closed[-2, 8]) * 15.0, atol=1e-9)


def test_the_fit_closes_cycles_and_says_so():
    cyclic, plain = swing(1.0, speed=1.0, cyclic=True, name="walk"), swing(0.5, name="once")
    _, motions, report = fit_humanoid(ClipLibrary((cyclic, plain)))
    assert report.cyclic == (True, False) and report.clips[1].cycle is None
    assert missed_end(motions[0]) < 1e-6
    said = [s for s in report.sentences() if "cycle" in s]
    assert len(said) == 1 and said[0].startswith("walk: The cycle did not close by 0.0 degrees")


@pytest.mark.parametrize(("name", "gap"), [("walk", 29), ("spinkick", 48), ("run", 18)])
def test_real_cycles_run_on_without_a_jump(data_dir, name, gap):
    clip = read_clip(data_dir / f"deepmimic_txt/humanoid3d_{name}.txt")
    humanoid, motions, report = fit_humanoid(clip)
    assert report.cyclic == (True,) and missed_end(motions[0]) < 1e-6
    found = report.clips[0].cycle
    assert found is not None and found.gap_deg == pytest.approx(gap, abs=1)
    ref = Reference(humanoid, motions, 30.0, [c.name for c in report.clips], report.cyclic)
    cycle = int(ref.length[0]) - 1
    frames = torch.arange(3 * cycle)
    pose = ref.gather(torch.zeros_like(frames), frames)
    for path in (pose.pos.flatten(1).numpy(), pose.qpos[:, 7:].numpy()):
        steps = np.abs(path[1:] - path[:-1]).max(1)
        assert float(steps[cycle - 2 : cycle + 2].max()) <= 1.05 * float(steps[:cycle].max())
    # Velocities stand still over the seam as they do within, up to the kink of a spread gap.
    jumps = norm(pose.linvel.diff(dim=0)).amax(-1)
    assert float(jumps[cycle - 1 : cycle + 1].max()) < 1.1 * float(jumps[5 : cycle - 5].max())


def test_a_clip_whose_arm_ends_a_turn_away_is_played_once(data_dir):
    clip = read_clip(data_dir / "deepmimic_txt/humanoid3d_dance_a.txt")
    _, _, report = fit_humanoid(clip)
    assert clip.cyclic and report.cyclic == (False,)
    assert any("Not repeated" in s and "right_shoulder" in s for s in report.sentences())
