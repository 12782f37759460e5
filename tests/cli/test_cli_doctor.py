"""`poise doctor CLIP` and the guesses of `poise info`: what they print, write and refuse."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from tiny_clips import bvh, put

from poise.cli.doctor import _hidden_rate, worsened
from poise.cli.info import _guess
from poise.cli.main import main
from poise.formats import read_clip, write_clip
from poise.kinematics import Examination, Fault
from poise.motion import shifted

WALK = Path(str(files("poise") / "data/walk.bvh"))


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The walk, 6 cm too high, with a jump of half a metre in its middle."""
    clip = shifted(read_clip(WALK), (0.0, 0.0, 0.06))
    path = np.array(clip.root_pos)
    path[43:, 0] += 0.5
    target = tmp_path_factory.mktemp("doctor") / "broken.bvh"
    write_clip(clip.replaced(root_pos=path), target)
    return target


def said(capsys: pytest.CaptureFixture[str], *argv: object) -> str:
    assert main([str(a) for a in argv]) == 0
    out, complained = capsys.readouterr()
    assert complained == f"reading {argv[1]}\n"
    return out


def test_a_rest_pose_for_other_tools(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    target = tmp_path / "rested.bvh"
    facts = json.loads(said(capsys, "doctor", WALK, "--rest-pose", "-o", target, "--json"))["result"]
    assert "The rest pose is a T-pose now" in facts["fixed"]["rest_pose"]
    assert facts["fixed"]["frames"] == facts["frames"]
    assert "rest pose: T-pose" in said(capsys, "info", target)


def test_a_clean_clip_is_told_to_be_clean(capsys: pytest.CaptureFixture[str]) -> None:
    text = said(capsys, "doctor", WALK)
    assert text.endswith(f"\n{WALK}: nothing wrong was found.\n")
    # The unit and the vertical for which that holds are told.
    assert "centimetres taken, which make the person 1.64 m tall" in text and "Y taken" in text


def test_faults_are_listed_with_joint_frames_and_size(broken: Path, capsys) -> None:
    text = said(capsys, "doctor", broken)
    row = next(line for line in text.splitlines() if "teleport" in line)
    assert "Hips" in row and " 43 " in row and "0.5" in row
    assert "float" in text and "whole body" in text and "6" in text


def test_json_holds_every_fault(broken: Path, capsys) -> None:
    facts = json.loads(said(capsys, "doctor", broken, "--json"))["result"]
    assert facts["frames"] == 86 and facts["judged"]
    jump = next(f for f in facts["faults"] if f["kind"] == "teleport")
    assert (jump["joint"], jump["start"], jump["unit"], jump["repairable"]) == ("Hips", 43, "m", True)
    assert "fixed" not in facts


def test_fix_writes_the_clip_without_its_faults(broken: Path, tmp_path: Path, capsys) -> None:
    target = tmp_path / "mended.bvh"
    facts = json.loads(said(capsys, "doctor", broken, "--fix", "-o", target, "--json"))["result"]
    assert len(facts["faults"]) >= 2 and facts["fixed"]["faults"] == []
    again = json.loads(said(capsys, "doctor", target, "--json"))["result"]
    assert again["faults"] == []
    mended, original = read_clip(target), read_clip(WALK)
    assert mended.skeleton.names == original.skeleton.names and mended.fps == original.fps
    assert np.linalg.norm(mended.positions() - original.positions(), axis=-1).max() < 0.03


def test_notes_of_a_repair_are_sentences_and_told_once(broken: Path, tmp_path: Path, capsys) -> None:
    assert main(["doctor", str(broken), "--fix", "-o", str(tmp_path / "a.bvh")]) == 0
    lines = capsys.readouterr().out.splitlines()
    told = [line.removeprefix("  - ") for line in lines if line.startswith("  - ")]
    assert all(len(note) > 8 for note in told) and len(told) == len({*told})
    argv = ["doctor", str(broken), "--fix", "-o", str(tmp_path / "b.bvh"), "--json"]
    assert main(argv) == 0
    assert isinstance(json.loads(capsys.readouterr().out)["notes"], list)


def test_after_is_what_doctor_says_of_the_written_file(tmp_path: Path, capsys) -> None:
    """A T-pose before the motion is left out when it is read, so that the written file has none."""
    clip = read_clip(WALK)
    root, rot = (np.concatenate((x[:1], x)) for x in (clip.root_pos, clip.rot))
    rot[:1] = [1.0, 0.0, 0.0, 0.0]
    source, target = tmp_path / "rest.bvh", tmp_path / "mended.bvh"
    write_clip(clip.replaced(root_pos=root, rot=rot), source)
    facts = json.loads(said(capsys, "doctor", source, "--fix", "-o", target, "--json"))["result"]
    assert "rest frame" in {f["kind"] for f in facts["faults"]}
    again = json.loads(said(capsys, "doctor", target, "--json"))["result"]
    assert {k: facts["fixed"][k] for k in ("faults", "figures", "frames")} == {
        k: again[k] for k in ("faults", "figures", "frames")
    }
    assert again["faults"] == []


def test_a_rate_that_is_no_longer_told_is_not_mended() -> None:
    rate = Fault("frame rate", "", 0, 9, 60.0)
    with_it, without = Examination((rate,), {}, True), Examination((), {}, True)
    assert "was not changed" in _hidden_rate(with_it, without)
    assert "--fps 60." in _hidden_rate(with_it, without)
    assert _hidden_rate(with_it, with_it) == _hidden_rate(without, without) == ""


def test_fix_shows_before_and_after(broken: Path, tmp_path: Path, capsys) -> None:
    text = said(capsys, "doctor", broken, "--fix", "-o", tmp_path / "mended.bvh")
    row = next(line for line in text.splitlines() if "teleport, spells" in line)
    assert [c.strip() for c in row.split("│")[3:5]] == ["1", "0"]
    assert "0 after" in text.splitlines()[-2]
    assert "The root moves by up to 505 mm (frame 46)" in text


def test_what_mending_made_worse_is_named(broken: Path, tmp_path: Path, capsys) -> None:
    facts = json.loads(said(capsys, "doctor", broken, "--fix", "-o", tmp_path / "a.bvh", "--json"))
    assert facts["result"]["fixed"]["worse"] == []
    # Figures of what is written, made up: a jerk twice as large, a slide that hardly differs.
    figures = facts["result"]["figures"]
    after = figures | {"jerk_max_m_per_s3": 2 * figures["jerk_max_m_per_s3"], "sole_slide_mm_per_s": 9.0}
    found, left = (Examination((), f, True) for f in (figures | {"sole_slide_mm_per_s": 1.0}, after))
    (worse,) = worsened(found, left)
    assert worse.startswith("jerk, largest (") and worse.endswith(" m/s^3)")


def test_a_clean_clip_is_written_as_it_was_read(tmp_path: Path, capsys) -> None:
    target = tmp_path / "same.bvh"
    assert "Nothing had to be mended" in said(capsys, "doctor", WALK, "--fix", "-o", target)
    a, b = read_clip(WALK), read_clip(target)
    np.testing.assert_allclose(a.positions(), b.positions(), atol=1e-6)
    np.testing.assert_allclose(a.rot, b.rot, atol=1e-6)


def test_mistakes_are_refused(refused, broken: Path, tmp_path: Path) -> None:
    refused("doctor", broken, "--fix", words=("--fix needs -o OUT",))
    refused("doctor", broken, "-o", "x.bvh", words=("-o OUT needs --fix",))
    refused("doctor", broken, "--rest-pose", words=("--rest-pose needs -o OUT",))
    refused("doctor", "--fix", words=("no clip was given",))
    refused("doctor", broken, "--fix", "-o", broken, words=("over itself",))
    refused("doctor", broken, "--fix", "-o", tmp_path / "a.xyz", words=("'.xyz'", ".bvh"))
    refused("doctor", tmp_path / "none.bvh", words=("no such file",))
    refused("info", WALK, "--ground", "low", words=("--ground", "'low'"))


def test_a_body_that_is_not_told_is_said_so(tmp_path: Path, capsys) -> None:
    text = said(capsys, "doctor", put(tmp_path, "tiny.bvh", bvh()))
    assert "No human body is told" in text


def test_every_guess_has_evidence_and_a_way_to_override_it(capsys) -> None:
    facts = json.loads(said(capsys, "info", WALK, "--json"))["result"]
    guesses = {g["what"]: g for g in facts["guesses"]}
    assert list(guesses) == ["up", "unit", "fps", "rest pose", "sides", "feet", "ground"]
    assert all(g["evidence"] and g["override"] for g in guesses.values())
    assert guesses["up"]["value"] == "Y" and guesses["unit"]["value"] == 0.01
    assert guesses["rest pose"]["value"] == "T-pose" and guesses["sides"]["value"] == "as named"
    assert guesses["feet"]["value"] == "LeftFoot, RightFoot" and abs(guesses["ground"]["value"]) < 0.02
    text = said(capsys, "info", WALK)
    assert "[--up Y|Z|-Y|-Z]" in text and "[--ground METRES" in text


def test_what_is_stated_is_no_guess(capsys) -> None:
    argv = ("info", WALK, "--up", "Y", "--unit", "0.01", "--fps", "60", "--json")
    facts = json.loads(said(capsys, *argv))["result"]
    why = {g["what"]: g["evidence"] for g in facts["guesses"]}
    assert (why["up"], why["unit"]) == ("Stated with --up", "Stated with --unit")
    # Played twice as fast, a walk is out of balance: the rate is obeyed, and doubted.
    assert why["fps"].startswith("Stated with --fps; but in ")
    assert "likely it has 30 frames per second" in why["fps"]
    facts = json.loads(said(capsys, "info", WALK, "--fps", "30", "--json"))["result"]
    assert {g["what"]: g["evidence"] for g in facts["guesses"]}["fps"] == "Stated with --fps"


def test_the_floor_can_be_stated_or_taken_from_the_soles(broken: Path, capsys) -> None:
    def ground(*more: str) -> float:
        facts = json.loads(said(capsys, "info", broken, "--json", *more))["result"]
        return next(g["value"] for g in facts["guesses"] if g["what"] == "ground")

    assert ground() == pytest.approx(0.06, abs=0.02)
    assert ground("--ground", "auto") == pytest.approx(0.0, abs=1e-3)
    assert ground("--ground", "0.04") == pytest.approx(ground() - 0.04, abs=1e-6)


def test_a_floor_that_is_0_but_for_rounding_is_0() -> None:
    guess = {"what": "ground", "value": 4.1633e-17, "evidence": "E", "override": "O"}
    assert _guess(guess) == "ground: 0 m. E. [O]"
    assert _guess({**guess, "value": -0.0125}) == "ground: -0.0125 m. E. [O]"


def test_sides_can_be_exchanged(tmp_path: Path, capsys) -> None:
    target = tmp_path / "swapped.bvh"
    assert main(["convert", str(WALK), str(target), "--swap-sides"]) == 0
    capsys.readouterr()
    facts = json.loads(said(capsys, "info", target, "--json"))["result"]
    sides = next(g for g in facts["guesses"] if g["what"] == "sides")
    assert sides["value"] == "exchanged" and sides["override"] == "--swap-sides"
    assert "left and right" in said(capsys, "doctor", target) or "sides" in said(
        capsys, "doctor", target
    )
    facts = json.loads(said(capsys, "doctor", target, "--swap-sides", "--json"))["result"]
    assert facts["faults"] == []


def test_keypoints_state_their_evidence(tmp_path: Path, answered) -> None:
    from poise.formats.point_raw import RawPoints, assemble_points
    from poise.formats.raw import ReadOptions

    clip = read_clip(WALK)
    points = clip.positions() * 1000
    raw = RawPoints("trc", tmp_path / "a.trc", tuple(clip.skeleton.names), points, 30.0)
    evidence = dict(assemble_points(raw, ReadOptions()).source.evidence)
    assert evidence["fps"] == "The file has 30 frames per second" and "code" not in evidence["unit"]


def test_feet_without_names_are_not_called_named(tmp_path: Path) -> None:
    """Feet that their place alone tells are said to be told so."""
    from poise.formats import read_clip
    from poise.kinematics.repair.guesses import find_guesses

    clip = read_clip(WALK)
    named = next(g for g in find_guesses(clip) if g.what == "feet")
    assert named.evidence.startswith("Named so and at the ends")
    numbers = tuple(f"j{k}" for k in range(len(clip.skeleton)))
    bare = clip.replaced(skeleton=replace(clip.skeleton, names=numbers))
    told = next(g for g in find_guesses(bare) if g.what == "feet")
    assert told.value is None or told.evidence.startswith("Not told by their names, but by their place")
