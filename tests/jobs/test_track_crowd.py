"""Several characters in one world move as each would alone, until they meet."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.track import TrackConfig, imitation_of, side_by_side, track
from poise.jobs.track.placement import place
from poise.jobs.track.surroundings import APART_M, crowd, places
from poise.jobs.tracker import Tracker
from poise.plan import LookaheadConfig
from poise.sim import CpuBackend, alone
from refusals import refused
from toy_human import swing
from toy_policy import toy_run, walk


@pytest.fixture(scope="module")
def tracker(tmp_path_factory: pytest.TempPathFactory) -> Tracker:
    return open_run(toy_run(tmp_path_factory.mktemp("run"))).tracker


def test_places() -> None:
    assert places(1).tolist() == [[0.0, 0.0]]
    assert places(3).tolist() == [[0.0, 0.0], [0.0, APART_M], [APART_M, 0.0]]
    many = places(16)
    apart = np.linalg.norm(many[:, None] - many[None], axis=-1) + 9 * np.eye(16)
    assert apart.min() == pytest.approx(APART_M)


def test_a_model_of_copies(tracker: Tracker) -> None:
    sim = tracker.config.sim
    single = alone(tracker.humanoid, sim)
    rows = crowd(tracker.humanoid, sim, 3)
    model = rows.get_model(0)
    assert model.nq == 3 * single.nq and model.nexclude == 3 * single.nexclude
    assert model.opt.timestep == sim.timestep and model.opt.integrator == single.opt.integrator
    assert model.body_mass.sum() == pytest.approx(3 * single.body_mass.sum())
    for name in ("jnt_range", "dof_damping", "dof_armature", "actuator_gainprm"):
        np.testing.assert_array_equal(getattr(model, name), np.concatenate([getattr(single, name)] * 3))
    assert model.body(single.nbody).name == f"2/{tracker.humanoid.bodies[0]}"
    rows.close()


def test_its_state_looks_like_that_of_worlds(tracker: Tracker) -> None:
    """The same coordinates and targets in one world and in worlds of their own."""
    placed = place(walk(0, 30), tracker)
    imitation = side_by_side(imitation_of(tracker, [placed]), 3)
    n = torch.arange(3)
    qpos, qvel = imitation.reference.coordinates(n, 4 * n)
    rows = crowd(tracker.humanoid, tracker.config.sim, 3)
    apart = CpuBackend(alone(tracker.humanoid), 3, threads=1)
    try:
        for backend in (rows, apart):
            backend.state.bind(("qfrc_damper",))
            backend.write(None, qpos, qvel)
            backend.drive.clear()
            backend.drive.ctrl.add_(qpos[:, 7:] + 0.1)
            backend.step(4)
        for name in ("qpos", "qvel", "qfrc_damper"):
            assert torch.allclose(rows.state[name], apart.state[name], atol=1e-7), name
        for name in ("xpos", "xquat", "xipos", "subtree_com", "cvel"):
            a, b = rows.state[name][:, 1:], apart.state[name][:, 1:]
            assert torch.allclose(a, b, atol=1e-7), name
        before = rows.snapshot()
        rows.write(torch.tensor([1]), qpos[1:2], qvel[1:2])
        assert torch.equal(rows.state.qpos[1], qpos[1])
        assert torch.equal(rows.state.qpos[[0, 2]], before[[0, 2], : qpos.shape[1]])
        rows.restore(before)
        assert torch.equal(rows.snapshot(), before)
        with refused("field-of-world"):
            rows.state.bind(("geom_xpos",))
    finally:
        rows.close()
        apart.close()


def test_each_tracks_as_if_alone(tracker: Tracker) -> None:
    alone = track(walk(0, 25), tracker, controller="policy")
    many = track(walk(0, 25), tracker, TrackConfig(controller="policy", count=3))
    want = alone.evaluation.recordings[0].qpos
    for k, recording in enumerate(many.evaluation.recordings):
        got = recording.qpos.copy()
        got[:, :2] -= places(3)[k]
        np.testing.assert_allclose(got, want, atol=1e-4)
    assert many.evaluation.card.episodes == 3
    assert many.imitation.library.names == ("walk-1", "walk-2", "walk-3")
    assert [t for _, t in many.failures] == [t for _, t in alone.failures] * 3


def test_each_looks_ahead_in_copies_of_itself_alone(tracker: Tracker) -> None:
    few = LookaheadConfig(candidates=12, horizon=4)
    config = TrackConfig(controller="lookahead", count=2, lookahead=few, threads=1)
    done = track(walk(0, 20), tracker, config)
    assert done.controller == "lookahead" and len(done.evaluation.recordings) == 2
    task = done.imitation
    rows = crowd(task.humanoid, task.config.sim, 2)
    env = task.env(1, None, False, 1, help_scale=0.0, guard=False, backend=rows)
    copies = task.bare(rewards=True).env(3, auto_reset=False, threads=1, help_scale=0.0, guard=False)
    env.reset_to(torch.arange(2), torch.tensor([0, 5]))
    obs = copies.restore(env.snapshot(torch.tensor([1])))
    state = rows.state.qpos[1], rows.state.qvel[1]
    for k in range(3):
        assert torch.equal(copies.backend.state.qpos[k], state[0])
        assert torch.equal(copies.backend.state.qvel[k], state[1])
    assert copies.clip.tolist() == [1, 1, 1] and copies.frame.tolist() == [5, 5, 5]
    torch.testing.assert_close(obs[0], env.observe()[1], atol=1e-5, rtol=1e-4)
    env.close()
    copies.close()


def test_a_crowd_of_another_skeleton_is_delivered(tracker: Tracker, tmp_path: Path) -> None:
    source = swing(0.7, 30.0)
    tracked = track(source, tracker, TrackConfig(controller="policy", count=2, reset_on_fail=True))
    done = tracked.write(tmp_path, hold=False)
    assert set(done.paths) == {
        "simulated_swing-1", "simulated_swing-2", "body_swing-1", "body_swing-2", "score", "report",
    }  # fmt: skip
    assert all(path.exists() for path in done.paths.values())
    one, two = (read_clip(done.paths[f"simulated_swing-{k}"]) for k in (1, 2))
    assert set(one.skeleton.names) == set(source.skeleton.names)
    assert tracked.motion(1).frames == source.frames
    # They begin side by side.
    assert (two.root_pos - one.root_pos)[0] == pytest.approx([0.0, APART_M, 0.0], abs=0.05)
    with refused("folder-needed", says="2"):
        tracked.write(tmp_path, tmp_path / "one.bvh")


def test_counts_that_make_no_sense() -> None:
    for count in (0, -1, 65):
        with refused("out-of-range", says="64"):
            TrackConfig(count=count)
