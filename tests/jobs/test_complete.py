"""From keyframes to a body, and a director's hand on it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from poise.body import find_anatomy
from poise.cli.complete import _say
from poise.cli.main import main
from poise.errors import PoiseError
from poise.formats import write_clip
from poise.jobs import complete as completing
from poise.jobs.complete import complete
from poise.jobs.open import open_run
from poise.jobs.track import track
from poise.jobs.track.direction import Direction, Weight, direction_of, rows_of
from poise.jobs.tracker import Tracker
from poise.kinematics import without_noise
from poise.kinematics.directed import Pin, TouchPoint, directed, pinned
from poise.motion import Clip
from poise.plan import LookaheadConfig
from poise.synthesis.keyframes import Retiming, retimed
from refusals import refused
from toy_human import swing, trembling
from toy_policy import walk

FEW = LookaheadConfig(candidates=10, horizon=6, smoothing=(0.0, 0.5))


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


def end(clip: Clip, kind: str, side: str) -> np.ndarray:
    """`(T, 3)` m, where a hand or foot is."""
    return clip.positions()[:, find_anatomy(clip.skeleton).of(kind, side)[0]]


def test_limbs_are_pinned_and_touch() -> None:
    clip = swing(2.0, speed=0.2)
    foot, hand = end(clip, "foot", "left"), end(clip, "hand", "right")
    point = tuple(hand[45] + np.array([0.05, 0.0, 0.12]))
    made, notes = directed(clip, (Pin("left_foot", 10, 13),), (TouchPoint("right_hand", 45, point),))
    assert notes == ()
    now = end(made, "foot", "left")
    assert np.abs(now[10:14] - foot[10]).max() < 2e-3
    assert np.linalg.norm(end(made, "hand", "right")[45] - point) < 2e-3
    # Everything else, and every other time, is as it was.
    np.testing.assert_allclose(made.positions()[58], clip.positions()[58], atol=1e-9)
    # The body follows a leg that is too short by millimetres.
    assert np.abs(made.root_pos - clip.root_pos).max() < 0.02
    # What was simulated is held at its middle place.
    still = pinned(clip, (Pin("left_foot", 10, 13),))
    assert np.ptp(end(still, "foot", "left")[10:14], axis=0).max() < 3e-3


@pytest.mark.parametrize("how", ["led", "held"])
def test_a_pinned_foot_stays_from_heel_to_toe(how: str) -> None:
    clip = walk()
    foot = find_anatomy(clip.skeleton).of("foot", "left")[0]
    toe = next(j for j, parent in enumerate(clip.skeleton.parents) if parent == foot)
    pins = (Pin("left_foot", 12, 20),)
    made = directed(clip, pins)[0] if how == "led" else pinned(clip, pins)
    assert np.ptp(clip.positions()[12:21, toe], axis=0).max() > 0.02
    assert np.ptp(made.positions()[12:21, toe], axis=0).max() < 3e-3
    # As the motion comes to the pin and leaves it, the toe sinks no deeper than it does anyway.
    low = min(0.0, clip.positions()[:, toe, 2].min())
    assert made.positions()[:, toe, 2].min() > low - 0.01


def test_what_cannot_be_is_said() -> None:
    clip = swing(1.0)
    far, notes = directed(clip, (), (TouchPoint("left_hand", 10, (3.0, 0.0, 1.0)),))
    assert "left_hand cannot reach" in notes[0] and "frame 10" in notes[0]
    assert np.isfinite(far.rot).all()
    root = clip.root_pos.copy()
    root[:, 2] += 0.5 * np.sin(np.linspace(0, np.pi, len(root)))
    up = clip.replaced(root_pos=root)
    _, notes = directed(up, (Pin("left_foot", 14, 15),))
    assert any("pinned in mid-air" in n for n in notes)
    with refused("frame-outside", says=("20", "40", "30")):
        directed(clip, (Pin("left_foot", 20, 40),))
    with refused("unknown-limb", says=("left_fot", "left_foot")):
        directed(clip, (Pin("left_fot", 2, 4),))


def test_words_of_a_director(tracker: Tracker) -> None:
    got = direction_of(("hands=3", "head=2:10-40"), ("left_foot:12-40",), ("right_hand:50:0.3,0.2,1.1",))
    assert got.weights == (Weight("hands", 3.0), Weight("head", 2.0, 10, 40))
    assert got.pins == (Pin("left_foot", 12, 40),)
    assert got.touches == (TouchPoint("right_hand", 50, (0.3, 0.2, 1.1)),)
    table = tracker.humanoid.table
    hands = rows_of(table, "hands")
    assert {table.rows[i].kind for i in hands} == {"hand"} and len(hands) == 2
    assert len(rows_of(table, "left_hand")) == 1 and len(rows_of(table, "all")) == len(table.rows)
    prices = Direction((Weight("hands", 3.0, 10, 20),)).prices(swing(2.0), table, 60, 30.0)
    assert prices is not None and prices[:9].sum() == 0 and float(prices[15, hands[0]]) == 10.0
    for words, message in (
        ((("hands",), (), ()), ("option-malformed", "hands")),
        ((("hands=-1",), (), ()), ("out-of-range", "hands")),
        (((), ("left_foot",), ()), ("option-malformed", "left_foot")),
        (((), ("left_foot:9-3",), ()), ("not-rising",)),
        (((), ("knee:1-3",), ()), ("unknown-limb", "knee")),
        (((), (), ("left_hand:5",)), ("option-malformed", "left_hand:5")),
    ):
        with refused(*message):
            direction_of(*words)
    with refused("unknown-body-part", says=("hadns", "hands")):
        rows_of(table, "hadns")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((("tail=3",), (), ()), ("unknown-body-part", "tail")),
        ((("head=2:900-950",), (), ()), ("frame-outside", ("head", "frame 900", "30"))),
        (((), ("left_foot:20-40",), ()), ("frame-outside", ("20", "40", "30"))),
        (((), (), ("right_hand:900:0,0,1",)), ("frame-outside", ("900", "30"))),
    ],
)
def test_what_cannot_be_asked_is_refused_before_gaps_are_filled(
    tracker: Tracker, words: tuple, message: tuple, monkeypatch: pytest.MonkeyPatch
) -> None:
    def filled(*given: object, **named: object) -> None:
        raise AssertionError("gaps were filled")

    monkeypatch.setattr(completing, "inbetween", filled)
    with refused(*message):
        complete(swing(1.0), (0, 15, 30), tracker, direction=direction_of(*words))
    with refused(*message):
        track(swing(1.0), tracker, direction=direction_of(*words))


def test_weights_and_pins_in_a_simulation(tracker: Tracker) -> None:
    clip = swing(1.5, speed=0.3)
    plain = track(clip, tracker, controller="lookahead", lookahead=FEW, supports="none", threads=1)
    asked = direction_of(("hands=20",), ("left_foot:8-18",))
    made = track(
        clip, tracker, controller="lookahead", lookahead=FEW, supports="none", threads=1, direction=asked
    )
    wanted = end(clip, "hand", "left")
    off = [np.linalg.norm(end(m.clip, "hand", "left") - wanted, axis=-1).mean() for m in (plain, made)]
    assert off[1] < off[0] + 0.01
    assert np.ptp(end(made.clip, "foot", "left")[8:19], axis=0).max() < 5e-3
    with refused("single-character-only"):
        track(clip, tracker, count=2, direction=asked)


def test_times_are_stretched_and_poses_stay() -> None:
    clip = swing(2.0, speed=1.0)
    longer, at = retimed(clip, (0, 20, 40, 59), (1.0, 2.0, 1.5))
    assert at == (0, 20, 60, 88) and longer.frames == 90
    for a, k in zip(at, (0, 20, 40, 59), strict=True):
        np.testing.assert_allclose(longer.positions()[a], clip.positions()[k], atol=1e-9)
    np.testing.assert_array_equal(longer.root_pos[:20], clip.root_pos[:20])
    assert retimed(clip, (0, 59), (1.0,))[0] is clip


def test_keyframes_become_a_simulated_motion(tracker: Tracker, tmp_path: Path) -> None:
    clip = swing(2.0)
    shown: set[str] = set()
    done = complete(
        clip, (0, 20, 40, 59), tracker, lookahead=FEW, threads=1, adapt=0, supports="none",
        progress=lambda what, n, of: shown.add(what),
    )  # fmt: skip
    assert done.at == done.keyframes == (0, 20, 40, 59) and len(done.met_mm) == 4
    assert shown == {"filling", "looking ahead"}
    names = [s.name for s in done.stages]
    assert names == ["filled", "simulated", "delivered"] and done.stages[0].key_mm < 1e-6
    assert done.card.help.force_mean_n == 0.0 and done.clip.frames == clip.frames
    assert "keyframes met to" in done.sentence or "Lost" in done.sentence
    paths = done.save(tmp_path / "out")
    assert paths["filled"].exists() and '"keys":[0,20,40,59]' in paths["report"].read_text()
    with refused("settings-conflict"):
        complete(clip, (0, 59), tracker, count=2)


def test_too_little_time_is_given_more(tracker: Tracker, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hips 1.2 m on in 0.1 s: the gap gets longer."""
    monkeypatch.setattr(completing, "ROUNDS", 2)
    clip = swing(0.8)
    root = clip.root_pos.copy()
    root[15:, 0] += 1.2
    done = complete(
        clip.replaced(root_pos=root), (0, 12, 15, 23), tracker, lookahead=FEW, threads=1, adapt=0,
        supports="none", retime=True, controller="lookahead",
    )  # fmt: skip
    assert done.retiming is not None and done.at[2] - done.at[1] > 3
    assert "Times were stretched" in done.retiming.sentence()


def test_stretched_times_are_told_by_the_frames_of_the_file() -> None:
    told = Retiming((0, 30, 53), (0, 51, 90), 60.0, (1.7, 1.7), called=(0, 60, 106)).sentence()
    assert "frame 60 is at 0.85 s instead of 0.50 s, frame 106 is at 1.50 s" in told


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "keys.bvh"
    write_clip(swing(1.5), file)
    out = tmp_path / "out"
    args = ["complete", str(file), "--keyframes", "0,20,44", "--adapt", "0", "--budget", "40"]
    assert main([*args, "-o", str(out), "--threads", "1", "--json"]) in (0, 3)
    told = json.loads(capsys.readouterr().out)
    assert told["result"]["keyframes"] == [0, 20, 44] and len(told["result"]["met_mm"]) == 3
    assert (out / "report.html").exists() and (out / "filled.bvh").exists()
    assert main([*args, "-o", str(tmp_path / "k.bvh"), "--kinematic"]) == 0
    assert (tmp_path / "k.bvh").exists()
    capsys.readouterr()
    for more, message in (
        (["--keyframes", "3"], "at least 2 keyframes"),
        (["--keyframes", "0,99"], "99"),
        (["--pin", "left_foot:10-99"], "the clip has 0 to 45"),
        (["--kinematic", "--pin", "left_foot:1-9"], "--kinematic has no body"),
    ):
        assert main([*args, "-o", str(tmp_path / "bad"), *more]) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "bad").exists()


def test_warnings_are_no_part_of_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    """They are notes, which are shown once, at the end."""
    warned = SimpleNamespace(stages=(), filled=SimpleNamespace(warnings=("the gap is long",)))
    _say(warned)  # type: ignore[arg-type]
    told = capsys.readouterr()
    assert "the gap is long" not in told.out + told.err


def test_neighbours_leave_nothing_to_fill(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = tmp_path / "keys.bvh", tmp_path / "out.bvh"
    write_clip(swing(0.5), file)
    argv = ["complete", str(file), "--keyframes", "0,1,2", "-o", str(out), "--kinematic"]
    assert main(argv) == 0 and out.exists()
    assert capsys.readouterr().out.count("nothing to fill between these keyframes") == 1


def test_a_config_keeps_its_own_lookahead(tracker: Tracker) -> None:
    from poise.jobs.track import TrackConfig

    config = TrackConfig(lookahead=FEW, controller="policy")
    done = complete(swing(1.0), (0, 29), tracker, replace(config, threads=1), adapt=0)
    assert done.controller == "policy"


def test_a_tremble_is_taken_off_before_keyframes_are_filled_between(
    tracker: Tracker, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Clip] = []

    def caught(clip: Clip, *_: object, **__: object) -> None:
        seen.append(clip)
        raise PoiseError("enough", code="internal-fault")

    monkeypatch.setattr(completing, "inbetween", caught)
    clip = trembling(swing(4.0, speed=0.5))
    poses = clip.replaced(rot=clip.rot[np.arange(clip.frames) // 15 * 15])
    for one in (clip, poses, clip.replaced(skeleton=clip.skeleton.with_source(raw=True))):
        with refused("internal-fault"):
            complete(one, (0, 30, 60, 90), tracker)
    calm, cleaned = without_noise(clip)
    np.testing.assert_array_equal(seen[0].rot, calm.rot)
    assert seen[0].skeleton.source.raw and cleaned.noise
    # Poses that are held between keyframes are no noise, and what is raw stays.
    np.testing.assert_array_equal(seen[1].rot, poses.rot)
    np.testing.assert_array_equal(seen[2].rot, clip.rot)
