"""Runs and the policy of earlier versions open, act as they did and go on; see tests/fixtures.

The stored figures are those of the version that made the runs, on one machine. Another one adds floats
in another order, and what falls or stumbles amplifies that: figures agree to a thousandth there (a ten
thousandth for the shipped policy), and whether an episode succeeded agrees exactly.
"""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.perpetual import perpetual_run
from poise.jobs.perpetual.evaluation import evaluate_clips, try_recovery
from poise.jobs.runs import evaluate, train, trained_policy
from poise.jobs.track import TrackConfig, imitation_of, track
from poise.jobs.track.placement import place
from poise.jobs.track.recovery_run import look_for, replay
from poise.jobs.tracker import Tracker
from poise.learn import Until, load_checkpoint
from poise.motion import trim
from poise.plan import SamplingConfig, SamplingResult
from poise.score import ScoreCard

OLD = Path(__file__).resolve().parents[1] / "fixtures/old"
TRACKER, EXPECTED = OLD / "tracker.safetensors", OLD / "expected.json"
#: Figures that the clock or the version decides.
_APART = ("seconds", "poise")

Results = tuple[dict[str, Any], dict[str, np.ndarray]]


# --- what is done with each; figures and arrays ---------------------------------------------------


def imitation_results(name: str) -> Results:
    """The score card of a run from 8 of its frames, and its first episode."""
    task = open_run(OLD / name).task
    frame = torch.linspace(0, int(task.reference.length[0]) - 2, 8).long()
    starts = torch.zeros_like(frame), frame
    done = evaluate(task, *trained_policy(OLD / name, task), starts=starts)
    return _figures(done.card), {"qpos": done.recordings[0].qpos}


def perpetual_results(name: str) -> Results:
    """Every clip with the run's policy, recovery trials, and a motion tracked by it."""
    task = open_run(OLD / name).task
    policy, _ = trained_policy(OLD / name, task)
    r = evaluate_clips(task, policy, threads=1)
    card = try_recovery(task, policy, 2, threads=1)
    tracked = track(
        trim(read_clip(OLD / "walk.bvh"), 0, 40), open_run(OLD / name).tracker, controller="policy"
    )
    found = {
        "succeeded": r.succeeded.tolist(),
        "tracked": r.tracked.tolist(),
        "mpjpe_mm": r.mpjpe_mm.tolist(),
        "mpjpe_global_mm": r.global_mm.tolist(),
        "recovered": [list(row.within) for row in card.rows],
        "track": _figures(tracked.evaluation.card),
    }
    return found, {}


def tracker_results() -> Results:
    """The embedded walk with the shipped policy."""
    done = track(read_clip(OLD / "walk.bvh"), open_run(TRACKER).tracker, controller="policy")
    return _figures(done.evaluation.card), {"qpos": done.evaluation.recordings[0].qpos}


def search_results() -> Results:
    """A walk that the shipped policy loses, looked for by 64 characters."""
    done = _searched(open_run(TRACKER).tracker)
    figures = {"whole": done.whole, "reached": done.reached, "tries": done.tries}
    return figures, {"actions": done.actions.numpy()}


def _searched(tracker: Tracker) -> SamplingResult:
    task = imitation_of(tracker, [place(read_clip(OLD / "aside.bvh"), tracker)])
    return look_for(tracker, task, SamplingConfig(characters=64, retries=2), threads=1)


def _figures(card: ScoreCard) -> dict[str, Any]:
    return {k: v for k, v in card.to_dict().items() if k not in _APART}


# --- comparing ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def expected() -> dict[str, Any]:
    return json.loads(EXPECTED.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def arrays() -> dict[str, np.ndarray]:
    with np.load(OLD / "expected.npz", allow_pickle=False) as file:
        return dict(file)


def _agree(have: Any, want: Any, relative: float, where: str = "") -> None:
    """Everything that was there is there and is the same; more may be there."""
    if isinstance(want, dict):
        for key, value in want.items():
            assert key in have, f"{where}/{key} is missing"
            _agree(have[key], value, relative, f"{where}/{key}")
    elif isinstance(want, list):
        assert len(have) == len(want), where
        for k, value in enumerate(want):
            _agree(have[k], value, relative, f"{where}/{k}")
    elif isinstance(want, float):
        same = math.isclose(have, want, rel_tol=relative, abs_tol=relative)
        assert same or (math.isnan(have) and math.isnan(want)), f"{where}: {have}, was {want}"
    else:
        assert have == want, f"{where}: {have}, was {want}"


@pytest.mark.parametrize("name", ["imitate", "explicit"])
def test_an_imitation_run_opens_and_scores_as_it_did(
    name: str, expected: dict[str, Any], arrays: dict[str, np.ndarray]
) -> None:
    figures, found = imitation_results(name)
    _agree(figures, expected[name], 1e-3)
    np.testing.assert_allclose(found["qpos"], arrays[f"{name}/qpos"], atol=1e-3)


@pytest.mark.parametrize("name", ["perpetual", "perpetual_stopped"])
def test_a_perpetual_run_opens_and_tracks_as_it_did(name: str, expected: dict[str, Any]) -> None:
    figures, _ = perpetual_results(name)
    _agree(figures, expected[name], 1e-3)


def test_the_shipped_policy_does_the_walk_as_it_did(
    expected: dict[str, Any], arrays: dict[str, np.ndarray]
) -> None:
    figures, found = tracker_results()
    assert figures["succ"] == 1.0
    _agree(figures, expected["tracker"], 1e-4)
    # That version shifted hinges by whole turns for which their ranges have room.
    then = arrays["tracker/qpos"].copy()
    then[:, 7:] += 2 * np.pi * np.round((found["qpos"][0, 7:] - then[0, 7:]) / (2 * np.pi))
    np.testing.assert_allclose(found["qpos"], then, atol=1e-4)


def test_a_motion_that_was_found_is_found_again_and_replays(
    expected: dict[str, Any], arrays: dict[str, np.ndarray]
) -> None:
    tracker = open_run(TRACKER).tracker
    clip = read_clip(OLD / "aside.bvh")
    assert track(clip, tracker, TrackConfig(controller="policy")).failures
    task = imitation_of(tracker, [place(clip, tracker)])
    figures, found = search_results()
    # Which of many characters is best may be another one on another machine; that it is found may not.
    assert figures["whole"] and figures["reached"] == expected["search"]["reached"]
    assert found["actions"].shape == arrays["search/actions"].shape
    # What the earlier version found, action by action.
    kept = torch.from_numpy(arrays["search/actions"])
    done = replayed(tracker, task, kept)
    assert bool(done.succeeded.all())
    assert float(done.global_mm) == pytest.approx(expected["replay"]["mpjpe_global_mm"], rel=0.05)


def replayed(tracker: Tracker, task: Any, actions: torch.Tensor) -> Any:
    """Results of one character that repeats actions `(T, A)`."""
    found = SamplingResult(actions, len(actions), 0.0, 0)
    return evaluate_clips(task, replay(found, tracker.policy), threads=1)


@pytest.mark.parametrize("name", ["imitate", "explicit"])
def test_an_imitation_run_goes_on(name: str, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(OLD / name, tmp_path / "run"))
    result = train(open_run(folder).task, folder, Until(iterations=5), threads=1, tensorboard=False)
    assert result.last is not None and result.last.iteration == 5
    assert math.isfinite(result.last.reward)


def test_a_stopped_perpetual_run_goes_on_to_its_end(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(OLD / "perpetual_stopped", tmp_path / "run"))
    config = reopen_config(folder)
    task = perpetual_run.resume(folder, config)
    done = perpetual_run.train(task, folder, Until(iterations=12), threads=1, tensorboard=False)
    assert done.results is not None and (folder / "policy.safetensors").exists()


def reopen_config(folder: Path) -> Any:
    """The settings of a run as this version reads them."""
    return perpetual_run.config_of(load_checkpoint(folder / "run.safetensors")[1]["config"])
