"""Poses with times, and keyframes of which only some parts are known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from poise.body import find_anatomy
from poise.cli.main import main
from poise.formats import read_clip, write_clip
from poise.jobs.complete import complete
from poise.jobs.open import open_run
from poise.jobs.track.direction import direction_of
from poise.kinematics.directed import PELVIS, TouchPoint, directed
from poise.motion import Clip
from poise.plan import LookaheadConfig
from poise.synthesis.keyframes import Partial, moved_to, partials_of, timed, times_of
from refusals import refused
from toy_human import swing
from toy_policy import walk

FEW = LookaheadConfig(candidates=10, horizon=6, smoothing=(0.0, 0.5))


def poses(clip: Clip, frames: tuple[int, ...]) -> Clip:
    """Some frames of a clip, one after another."""
    rows = list(frames)
    return clip.replaced(root_pos=clip.root_pos[rows], rot=clip.rot[rows])


def test_keyframes_go_where_they_are_wanted() -> None:
    clip = poses(swing(2.0), (0, 20, 50))
    made, at = timed(clip, (0, 1, 2), (0.0, 1.0, 1.5))
    assert at == (0, round(clip.fps), round(1.5 * clip.fps))
    assert made.frames == at[-1] + 1
    for k, frame in enumerate(at):
        np.testing.assert_allclose(made.root_pos[frame], clip.root_pos[k], atol=1e-12)
    # Times count from the first.
    assert timed(clip, (0, 1, 2), (3.0, 4.0, 4.5))[1] == at
    with refused("count-differs", says="2"):
        timed(clip, (0, 1, 2), (0.0, 1.0))
    with refused("not-rising", says="1"):
        timed(clip, (0, 1, 2), (0.0, 1.0, 1.0))
    assert moved_to(15, (10, 20), (10, 40)) == 25 and moved_to(25, (10, 20), (10, 40)) == 45


def test_words() -> None:
    assert times_of("0, 1.2 2") == (0.0, 1.2, 2.0)
    assert partials_of(["45", "50:hands,pelvis"]) == (Partial(45), Partial(50, ("hands", "pelvis")))
    for wrong, match in (
        (["x:hands"], ("option-malformed", "x:hands")),
        (["4:hand"], ("unknown-body-part", "hand")),
    ):
        with refused(*match):
            partials_of(wrong)
    with refused("option-malformed"):
        times_of("0,soon")


def test_parts_of_a_keyframe_are_where_the_clip_has_them() -> None:
    clip = swing(1.0)
    touches = Partial(12, ("left_hand", "pelvis")).touches(clip)
    assert [(t.limb, t.frame) for t in touches] == [("left_hand", 12), ("pelvis", 12)]
    hand = find_anatomy(clip.skeleton).of("hand", "left")[0]
    np.testing.assert_allclose(touches[0].point, clip.positions()[12, hand])
    assert len(Partial(12).touches(clip)) == 5
    with refused("frame-outside"):
        Partial(99).touches(clip)


def test_the_pelvis_is_led_over_feet_that_stay() -> None:
    clip = swing(2.0, speed=0.0)
    point = clip.root_pos[30] + np.array([0.06, 0.0, -0.05])
    x, y, z = point
    made, notes = directed(clip, (), (TouchPoint(PELVIS, 30, (float(x), float(y), float(z))),))
    assert notes == ()
    np.testing.assert_allclose(made.root_pos[30], point, atol=1e-9)
    feet = list(find_anatomy(clip.skeleton).of("foot"))
    moved = np.linalg.norm(made.positions()[:, feet] - clip.positions()[:, feet], axis=-1)
    assert moved.max() < 5e-3
    np.testing.assert_allclose(made.root_pos[0], clip.root_pos[0], atol=1e-9)


def test_a_directors_frames_are_those_of_the_file() -> None:
    asked = direction_of(("head=2:12-20", "hands=3"), ("left_foot:10-15",), ("right_hand:20:1,0,1",))
    there = asked.moved(lambda frame: moved_to(frame, (10, 20), (10, 40)))
    assert [(w.first, w.last) for w in there.weights] == [(16, 40), (None, None)]
    assert [(p.first, p.last) for p in there.pins] == [(10, 25)]
    assert [t.frame for t in there.touches] == [40]


def test_poses_become_a_motion(tmp_path: Path, capsys) -> None:
    source = walk()
    three = poses(source, (0, 30, 60))
    tracker = open_run(None).tracker
    how = {"adapt": 0, "lookahead": FEW, "threads": 1, "controller": "lookahead"}
    done = complete(three, (0, 1, 2), tracker, times=(0.0, 1.0, 2.0), **how)
    assert done.at == (0, 30, 60) and done.keyframes == (0, 1, 2)
    assert not done.failures and np.mean(done.met_mm) < 150
    with refused("keyframe-misplaced", says="9"):
        complete(three, (0, 1, 2), tracker, partial=(Partial(9),), **how)
    file = tmp_path / "poses.bvh"
    write_clip(three, file)
    words = ["complete", str(file), "--keyframes", "all", "-o", str(tmp_path / "out"), "--json"]
    assert main(words) == 2
    assert "leaves nothing to fill" in capsys.readouterr().err
    quick = ["--adapt", "0", "--budget", "30", "--threads", "1", "--controller", "lookahead"]
    assert main([*words, "--times", "0,1,2", *quick]) == 0
    assert json.loads(capsys.readouterr().out)["result"]["at"] == [0, 30, 60]
    filled = tmp_path / "filled.bvh"
    still = ["complete", str(file), "--keyframes", "all", "--kinematic", "-o", str(filled)]
    assert main([*still, "--times", "0,1,2", "--adapt", "0"]) == 0
    assert read_clip(filled).frames == 61


def test_what_is_known_in_part_is_minded() -> None:
    source = walk()
    tracker = open_run(None).tracker
    how = {"adapt": 0, "lookahead": FEW, "threads": 1, "controller": "lookahead"}
    keys, frame = (0, source.frames - 1), source.frames // 2
    plain = complete(source, keys, tracker, **how)
    known = complete(source, keys, tracker, partial=(Partial(frame),), **how)
    goal = np.array([t.point for t in Partial(frame).touches(source)])

    def off(done) -> float:
        there = np.array([t.point for t in Partial(frame).touches(done.delivered(hold=False))])
        return float(np.linalg.norm(there - goal, axis=-1).mean())

    assert off(known) < off(plain)
