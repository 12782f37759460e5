"""A part of a motion is simulated anew and fades back into the earlier simulation."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from poise.cli.main import main
from poise.formats import read_clip, write_clip
from poise.jobs.complete import complete
from poise.jobs.open import open_run
from poise.jobs.result import Result
from poise.jobs.track import track
from poise.jobs.track.direction import Direction, Weight
from poise.jobs.track.retaking import FADE_S, SETTLE_S, changed_s, eased, part_of
from poise.jobs.track.simulation import FILE, Retake, Simulation, read_simulation, retake_of
from poise.jobs.tracker import Tracker
from poise.learn.checkpoint import load_checkpoint, save_checkpoint
from poise.motion import Clip, trim
from poise.plan import LookaheadConfig
from refusals import refused
from toy_policy import walk

FEW = LookaheadConfig(candidates=10, horizon=6, smoothing=(0.0, 0.5))
HOW = {"lookahead": FEW, "threads": 1, "supports": "none"}


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


@pytest.fixture(scope="module")
def clip() -> Clip:
    return walk(0, 72)


@pytest.fixture(scope="module")
def earlier(tracker: Tracker, clip: Clip) -> Result:
    return track(clip, tracker, **HOW)


def test_only_the_part_changes(tracker: Tracker, clip: Clip) -> None:
    how = HOW | {"lookahead": replace(FEW, candidates=16)}
    earlier = track(clip, tracker, **how)
    assert earlier.simulation is not None
    asked = Retake(earlier.simulation, 0.3, 0.6)
    arms = Direction((Weight("arms", 5.0),))
    made = track(clip, tracker, retake=asked, seed=3, direction=arms, **how)
    rate, frames = earlier.simulation.rate_hz, earlier.simulation.frames
    assert made.simulation is not None
    assert made.simulation.frames == frames
    changed = (made.simulation.qpos != earlier.simulation.qpos).any(1).nonzero()[:, 0]
    first, last = int(changed[0]), int(changed[-1])
    assert round(0.3 * rate) < first <= round(0.3 * rate) + 2
    assert last <= round((0.6 + SETTLE_S + FADE_S) * rate)
    # What is recorded is what was stored, in every frame.
    qpos = made.evaluation.recordings[0].qpos
    np.testing.assert_array_equal(qpos, made.simulation.qpos.numpy())
    kept = torch.tensor([t for t in range(frames) if t < first or t > last])
    pos, before = made.evaluation.rollouts.pos[0], earlier.evaluation.rollouts.pos[0]
    torch.testing.assert_close(pos[kept], before[kept], atol=1e-5, rtol=0)
    assert not made.failures and made.card.help.force_mean_n == 0.0
    assert any("simulated anew" in note for note in made.notes)
    # The seams are no jerkier than the motion.
    third = torch.diff(pos.double(), n=3, dim=0).norm(dim=-1).mean(1)
    assert third[max(first - 4, 0) :].max() < 1.5 * torch.diff(before.double(), n=3, dim=0).norm(
        dim=-1
    ).mean(1).max()  # fmt: skip
    again = track(clip, tracker, retake=asked, seed=3, direction=arms, **how)
    np.testing.assert_array_equal(again.evaluation.recordings[0].qpos, qpos)


def test_to_the_end_there_is_no_seam(tracker: Tracker, clip: Clip, earlier: Result) -> None:
    assert earlier.simulation is not None
    made = track(clip, tracker, retake=Retake(earlier.simulation, 0.5, 99.0), seed=1, **HOW)
    assert any("to its end" in note for note in made.notes)
    assert made.simulation is not None
    assert torch.equal(made.simulation.qpos[:15], earlier.simulation.qpos[:15])


def test_files_hold_what_is_needed(tracker: Tracker, clip: Clip, earlier: Result, tmp_path: Path):
    paths = earlier.write(tmp_path / "out").paths
    assert paths["simulation"].name == FILE
    kept = read_simulation(tmp_path / "out")
    assert earlier.simulation is not None
    assert torch.equal(kept.qpos, earlier.simulation.qpos)
    assert torch.equal(kept.action, earlier.simulation.action)
    hands = Direction((Weight("arms", 5.0),))
    made = track(clip, tracker, retake=Retake(tmp_path / "out", 0.3, 0.6), direction=hands, **HOW)
    assert made.simulation is not None
    # So is what is written: elsewhere it is as it was, in a folder or not.
    first, last = changed_s(kept, made.simulation)
    t = np.arange(clip.frames) / clip.fps
    beside = (t <= first) | (t >= last)
    assert 5 < beside.sum() < clip.frames
    two = made.write(tmp_path / "two").paths["simulated"]
    written = [read_clip(p).positions() for p in (paths["simulated"], two)]
    np.testing.assert_allclose(written[1][beside], written[0][beside], atol=2e-6, rtol=0)
    assert np.abs(written[1][~beside] - written[0][~beside]).max() > 1e-4
    asked = Retake(earlier.simulation, 0.3, 0.6)
    again = track(clip, tracker, retake=asked, direction=hands, **HOW)
    np.testing.assert_allclose(
        again.clip.positions()[beside], earlier.clip.positions()[beside], atol=1e-9, rtol=0
    )
    free = again.delivered(hold=False).positions(), earlier.delivered(hold=False).positions()
    np.testing.assert_allclose(free[0][beside], free[1][beside], atol=1e-9, rtol=0)
    # Keyframes are completed anew in part, too.
    keys = (0, clip.frames // 2, clip.frames - 1)
    one = complete(clip, keys, tracker, adapt=0, **HOW)
    assert one.simulation is not None
    part = Retake(one.simulation, 0.3, 0.6)
    two = complete(clip, keys, tracker, adapt=0, retake=part, **HOW)
    assert any("simulated anew" in note for note in two.notes)
    with refused("settings-conflict"):
        complete(clip, keys, tracker, retime=True, retake=part, **HOW)


def test_what_cannot_be_is_said(tracker: Tracker, clip: Clip, earlier: Result, tmp_path: Path) -> None:
    kept = earlier.simulation
    assert kept is not None
    with refused("length-differs"):
        track(trim(clip, 0, clip.frames // 2), tracker, retake=Retake(kept, 0.1, 0.3), **HOW)
    with refused("range-beyond-end", says="50"):
        track(clip, tracker, retake=Retake(kept, 50.0, 51.0), **HOW)
    with refused("not-rising"):
        Retake(kept, 2.0, 1.0)
    with refused("single-character-only", says="several characters"):
        track(clip, tracker, retake=Retake(kept, 0.1, 0.3), count=2)
    with refused("option-needs-option"):
        retake_of("1-2", None)
    with refused("option-needs-option", says="--range"):
        retake_of(None, tmp_path)
    with refused("option-malformed"):
        retake_of("1 to 2", tmp_path)
    with refused("simulation-missing"):
        read_simulation(tmp_path)
    lost = Simulation(kept.qpos, kept.qvel, kept.action, kept.rate_hz, kept.bodies, kept.hinges, 20)
    with refused("range-after-loss"):
        part_of(lost, Retake(lost, 1.0, 2.0))
    # What was lost later is done anew to its end.
    assert part_of(lost, Retake(lost, 0.2, 0.4)) == (6, kept.frames - 1)


def test_damaged_files_are_refused(earlier: Result, tmp_path: Path) -> None:
    assert earlier.simulation is not None
    path = tmp_path / FILE
    earlier.simulation.save(path)
    tensors, meta = load_checkpoint(path)
    for name, value in (("qpos", tensors["qpos"][:, :9]), ("action", tensors["action"] * torch.nan)):
        save_checkpoint(path, {**tensors, name: value}, meta)
        with refused("file-damaged", says=name):
            read_simulation(path)
    save_checkpoint(path, tensors, {**meta, "hinges": 3})
    with refused("wrong-type", says="hinges"):
        read_simulation(path)


def test_the_command_line_does_the_same(clip: Clip, tmp_path: Path, capsys) -> None:
    file = tmp_path / "walk.bvh"
    write_clip(clip, file)
    quick = ["--budget", "30", "--threads", "1", "--json"]
    assert main(["track", str(file), "-o", str(tmp_path / "one"), *quick]) == 0
    capsys.readouterr()
    part = ["--range", "0.3-0.6", "--from", str(tmp_path / "one")]
    assert main(["track", str(file), "-o", str(tmp_path / "two"), *quick, *part]) == 0
    said = json.loads(capsys.readouterr().out)
    assert any("simulated anew" in note for note in said["notes"])
    assert said["outputs"]["simulation"].endswith(FILE)
    nowhere = ["--range", "0.3-0.6", "--from", str(tmp_path)]
    assert main(["track", str(file), "-o", str(tmp_path / "three"), *quick, *nowhere]) == 2
    assert "no simulation" in capsys.readouterr().err
    assert not (tmp_path / "three").exists()


def test_easing_begins_and_ends_at_rest() -> None:
    s = eased(torch.linspace(-1.0, 2.0, 301).double())
    assert s[0] == 0 and s[-1] == 1
    assert float(torch.diff(s, n=2).abs().max()) < 1e-3
