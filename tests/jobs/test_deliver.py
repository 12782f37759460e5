"""The delivered motion has the source's frames, rate and skeleton."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from poise.formats import read_clip
from poise.jobs.deliver import Evaluation, finished, floor_of, lost_at, simulated_clip
from poise.jobs.result import Result
from poise.jobs.runs import evaluate
from poise.kinematics import examine, sole_slide
from poise.motion import Clip, ClipLibrary, ground_shift
from poise.recipes import ResidualForce, build
from poise.score import Recording
from toy_human import swing


def played(*clips: Clip) -> tuple:
    """The task of some clips and an evaluation with recordings of the reference itself."""
    imitation = build(ClipLibrary(clips), ResidualForce(num_envs=2))
    ref = imitation.reference
    rows = [range(int(a), int(a + n)) for a, n in zip(ref.start, ref.length, strict=True)]
    recordings = [Recording(c, 0, ref.qpos[list(r)].numpy(), c) for c, r in enumerate(rows)]
    return imitation, Evaluation(None, None, recordings)  # type: ignore[arg-type]


@pytest.mark.parametrize("fps", [24.0, 30.0, 60.0, 120.0])
def test_frames_rate_and_skeleton_are_the_sources(fps):
    source = swing(1.0, fps, speed=1.0, name="source")
    imitation, evaluation = played(source)
    out = simulated_clip(imitation, evaluation)
    assert (out.frames, out.fps, out.name) == (source.frames, source.fps, "source")
    assert out.skeleton is source.skeleton and not out.cyclic
    # A recording of the reference is the source again, set on the floor.
    shift = out.positions() - source.positions()
    assert np.abs(shift[..., :2]).max() < 0.01 and np.ptp(shift[..., 2]) < 0.03


def test_a_clip_between_control_frames_ends_within_one():
    source = swing(1.02, 100.0)
    imitation, evaluation = played(source)
    out = simulated_clip(imitation, evaluation)
    assert out.fps == 100.0 and 0.0 <= source.seconds - out.seconds < 1 / 30


def test_a_library_and_a_cycle_are_delivered_clip_by_clip():
    walk, once = swing(1.0, 60.0, speed=1.0, cyclic=True, name="walk"), swing(0.5, 60.0, name="once")
    imitation, evaluation = played(walk, once)
    # Cyclic clips are evaluated over two rounds; one is delivered.
    longer = Recording(0, 0, np.repeat(evaluation.recordings[0].qpos, 2, 0), 0)
    evaluation = Evaluation(evaluation.card, evaluation.rollouts, [longer, evaluation.recordings[1]])
    outs = [simulated_clip(imitation, evaluation, k) for k in range(2)]
    assert [(o.name, o.frames) for o in outs] == [("walk", 61), ("once", 31)]


@dataclass(frozen=True)
class Card:
    delivered: tuple = ()


@pytest.mark.parametrize("height", [0.0, 0.07, -0.4])
def test_the_written_motion_is_as_high_as_its_source(height: float):
    low, high = swing(0.5, 60.0, name="low"), ground_shift(swing(0.5, 60.0, name="high"), height)
    imitation, evaluation = played(low, high)
    done = finished(imitation, replace(evaluation, card=Card()), hold=False)  # type: ignore[arg-type]
    for source in (low, high):
        out = done.clips[f"simulated_{source.name}"]
        assert np.abs(out.positions() - source.positions()).max() < 0.02
    # Soles that sank in the file cannot in the simulation: feet are as high as in the file all the same.
    for recording in evaluation.recordings:
        recording.qpos[:, 2] += 0.015
    again = finished(imitation, replace(evaluation, card=Card()), hold=False)  # type: ignore[arg-type]
    for name, clip in done.clips.items():
        assert np.abs(again.clips[name].positions() - clip.positions()).max() < 1e-6
    (told,) = (note for note in done.notes if note.startswith("high") and "as high as" in note)
    moved = -1000 * height
    # Up for a clip below the floor of the simulation, down for one above.
    assert float(told.split("moved by ")[1].split(" mm to stand")[0]) == pytest.approx(moved, abs=25)
    assert "--ground" not in told


class Nothing:
    """A policy that asks for nothing."""

    meta: dict

    def __init__(self, width: int):
        self.width = width

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        return torch.zeros(len(obs), self.width)


def test_a_real_evaluation_is_delivered_whole():
    source = swing(0.5, 60.0)
    imitation = build(source, ResidualForce(num_envs=2))
    extra = imitation.task.residual.dims if imitation.task.residual else 0
    policy = Nothing(len(imitation.humanoid.hinges) + extra)
    out = simulated_clip(imitation, evaluate(imitation, policy, {}))  # type: ignore[arg-type]
    assert (out.frames, out.fps, out.skeleton) == (source.frames, source.fps, source.skeleton)
    # Between two control steps it goes on as it moves, to the last frame.
    steps = np.linalg.norm(np.diff(out.positions(), axis=0), axis=-1).mean(1)
    assert (steps[-3:] > 0.3 * steps[-8:-3].mean()).all()
    # It begins on the first frame and then falls where physics takes it.
    assert np.ptp((out.positions() - source.positions())[0], axis=0).max() < 1e-3


def test_standing_feet_are_held_in_the_written_motion_and_told(tmp_path: Path) -> None:
    source = swing(0.5, 60.0, name="source")
    imitation = build(source, ResidualForce(num_envs=2))
    extra = imitation.task.residual.dims if imitation.task.residual else 0
    policy = Nothing(len(imitation.humanoid.hinges) + extra)
    evaluation = evaluate(imitation, policy, {})  # type: ignore[arg-type]
    raw = simulated_clip(imitation, evaluation)
    done = Result(imitation, evaluation).write(tmp_path / "raw", tmp_path / "raw.npz", hold=False)
    assert done.card.delivered == () and not any("held" in note for note in done.notes)
    off = read_clip(tmp_path / "raw.npz").positions() - raw.positions()
    assert np.ptp(off, axis=(0, 1)).max() < 1e-9 and abs(off[0, 0, 2] - floor_of(imitation)) < 0.046
    done = Result(imitation, evaluation).write(tmp_path / "held")
    (figures,) = json.loads((tmp_path / "held/score.json").read_text())["delivered"]
    deep = "point_penetration_mm"
    assert figures["delivered"][deep] <= figures["simulated"][deep] + 0.1
    # The slide of a file's soles is what the doctor says of it.
    made = read_clip(tmp_path / "held/simulated.bvh")
    assert figures["delivered"]["sole_slide_mm_per_s"] == pytest.approx(sole_slide(made), rel=1e-3)
    assert figures["source"]["sole_slide_mm_per_s"] == pytest.approx(sole_slide(source))
    # So is how deep the body sinks, of all three on the floor of the file.
    for stage, clip in (("source", source), ("delivered", made)):
        deep = examine(clip).figures["penetration_mm"]
        assert figures[stage]["penetration_mm"] == pytest.approx(deep, rel=1e-3, abs=1e-3)
    # It is on its motion for so short a time; where it is taken away from there, that is told.
    r = evaluation.rollouts
    away = r.pos.clone()
    away[evaluation.recordings[0].row, 9:] += 1.0
    assert lost_at(evaluation) == ()
    assert lost_at(replace(evaluation, rollouts=replace(r, pos=away))) == (9 / r.fps,)
    assert set(figures) == {
        "clip", "held_mean_mm", "held_max_mm", "left", "source", "simulated", "delivered"
    }  # fmt: skip
    # The score is that of the simulation, however the file was mended.
    assert done.card.foot_slide_mm_per_s == evaluation.card.foot_slide_mm_per_s
