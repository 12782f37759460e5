"""Several people in one file, points that are missing as 0 0 0, rates as text, decimal commas."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from handmade_numpy_files import aist, amass, save_npz, save_pickle
from handmade_people import NAMES, csv, trc, walk

from poise.formats import read_clip
from poise.formats.one_person import person_of
from poise.formats.point_arrays import HUMANML3D
from poise.formats.point_raw import without_zeros
from poise.motion import Clip
from refusals import refused

ASIDE = np.array([3.0, 0.0, 0.0])
TWO = np.concatenate((walk(), walk() + ASIDE), 1)


def notes(clip: Clip) -> str:
    return "\n".join(clip.skeleton.source.notes)


def put(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


def ankle(clip: Clip) -> np.ndarray:
    return clip.positions()[:, clip.skeleton.index("LeftFoot")]


MARKS = {
    "colon": ("{who}:{name}", "P1", "P2"),
    "underscore": ("{who}_{name}", "Anna", "Ben"),
    "number": ("{who} {name}", "person 1", "person 2"),
    "behind": ("{name}_{who}", "A", "B"),
    "brackets": ("{name} ({who})", "red", "blue"),
}


@pytest.mark.parametrize("form", ["trc", "csv", "npz"])
@pytest.mark.parametrize("mark", MARKS)
def test_one_of_two_people_by_their_labels(tmp_path: Path, mark: str, form: str) -> None:
    """The first is read, the other named, and --take reads the other, by name and by number."""
    pattern, one, two = MARKS[mark]
    names = tuple(pattern.format(who=who, name=n) for who in (one, two) for n in NAMES)
    path = tmp_path / f"a.{form}"
    if form == "npz":
        np.savez(path, positions=TWO, names=np.array(names), fps=30.0)
    else:
        path.write_text((trc if form == "trc" else csv)(TWO, names))
    clip = read_clip(path)
    assert f"holds 2 people: '{one}' was read; the other is '{two}' (--take NAME" in notes(clip)
    alone = read_clip(put(tmp_path, "alone.trc", trc(walk())))
    np.testing.assert_allclose(clip.positions(), alone.positions(), atol=1e-4)
    for take in (two, "1"):
        other = read_clip(path, take=take)
        np.testing.assert_allclose(other.positions(), alone.positions() + ASIDE, atol=1e-4)
    with refused("unknown-take", says=("2", "Zoe")):
        read_clip(path, take="Zoe")


def test_sides_and_single_people_are_no_crowd() -> None:
    """L_Knee and R_Knee are no two people, nor are a subject's prefix or markers in clusters."""
    here = Path("a.trc")
    for names in (
        tuple(f"{n[0]}_{n[1:]}" if n[0] in "LR" else n for n in NAMES),
        tuple(f"Anna:{n}" for n in NAMES),
        tuple(f"{n}_{k}" for n in NAMES[:6] for k in (1, 2, 3)),
        (*(f"Anna:{n}" for n in NAMES), "Ball:a", "Ball:b"),
    ):
        assert person_of(names, None, here) == (list(range(len(names))), names, [])


def test_an_axis_of_people(tmp_path: Path) -> None:
    """(T, P, K, 3) and (P, T, K, 3) alike, in arrays of keypoints, of joints and of SMPL."""
    both = np.stack((walk(), walk() + ASIDE), 1)
    for table in (both, both.swapaxes(0, 1)):
        path = tmp_path / "a.npz"
        np.savez(path, positions=table, names=np.array(NAMES), fps=30.0)
        assert "holds 2 people: '0' was read; the other is '1'" in notes(read_clip(path))
        alone = read_clip(put(tmp_path, "alone.trc", trc(walk()))).positions()
        np.testing.assert_allclose(read_clip(path, take="1").positions(), alone + ASIDE, atol=1e-4)
    data = amass(66, 40)
    two = {k: np.stack((data[k], data[k] + 0.5 * (k == "trans"))) for k in ("poses", "trans")}
    path = save_npz(tmp_path / "b.npz", {**data, **two})
    one, other = read_clip(path), read_clip(path, take="1")
    assert "holds 2 people" in notes(one)
    np.testing.assert_allclose(other.root_pos - one.root_pos, 0.5, atol=1e-9)
    np.testing.assert_allclose(one.root_pos, read_clip(save_npz(path, data)).root_pos, atol=1e-12)


def test_joints_of_several_people_in_one_array(tmp_path: Path) -> None:
    smpl = read_clip(save_npz(tmp_path / "s.npz", amass(66, 40))).positions()
    assert smpl.shape[1] == len(HUMANML3D)
    both = np.stack((smpl, smpl + ASIDE), 1)
    np.save(tmp_path / "a.npy", both)
    clip = read_clip(tmp_path / "a.npy", take="1")
    assert "holds 2 people: '1' was read; the other is '0'" in notes(clip) and clip.frames == 40


@pytest.mark.parametrize("make", ["by name", "by number", "list", "shared rate"])
def test_pickles_of_several_people(tmp_path: Path, make: str) -> None:
    """WHAM and VIBE by number, InterHuman by name with the rate beside, 4D-Humans as a list."""
    one, two = aist(), aist()
    two["smpl_trans"] = two["smpl_trans"] + np.float32(93.8)
    value: Any = {
        "by name": {"person1": one, "person2": two},
        "by number": {0: one, 1: two},
        "list": [one, two],
        "shared rate": {"fps": 60.0, "a": one, "b": two},
    }[make]
    path = save_pickle(tmp_path / "a.pkl", value)
    first, second = read_clip(path, allow_pickle=True), read_clip(path, allow_pickle=True, take="1")
    assert "holds 2 people" in notes(first) and "holds 2 people" in notes(second)
    np.testing.assert_allclose(np.abs(second.root_pos - first.root_pos), 1.0, atol=1e-5)


def holed(points: np.ndarray) -> np.ndarray:
    """Zeros in place of the left ankle in frames 20 to 23 and of the right wrist in frame 50."""
    out = points.copy()
    out[20:24, NAMES.index("LAnkle")] = 0.0
    out[50, NAMES.index("RWrist")] = 0.0
    return out


@pytest.mark.parametrize("form", ["trc", "csv", "npz"])
def test_zeros_are_missing_points(tmp_path: Path, form: str) -> None:
    points = walk() + np.array([1.0, 2.0, 0.0])
    path = tmp_path / f"a.{form}"
    if form == "npz":
        np.savez(path, positions=holed(points), names=np.array(NAMES), fps=30.0)
    else:
        path.write_text((trc if form == "trc" else csv)(holed(points)))
    clip = read_clip(path)
    assert "5 of 1530 points are written as 0 0 0" in notes(clip) and "LAnkle 4, RWrist 1" in notes(clip)
    assert clip.frames == 90
    whole = read_clip(put(tmp_path, "whole.trc", trc(points)))
    np.testing.assert_allclose(ankle(clip), ankle(whole), atol=0.03)


def test_the_origin_of_relative_points_is_a_place() -> None:
    """A pelvis that is always 0 0 0 is the origin of all others; an ankle that is so was never seen."""
    names = (*NAMES, "Pelvis")
    pelvis = (walk()[:, :1] + walk()[:, 1:2]) / 2
    relative = np.concatenate((walk() - pelvis, np.zeros((90, 1, 3))), 1)
    assert without_zeros(names, relative)[1] == []
    lost = relative.copy()
    lost[:, NAMES.index("LAnkle")] = 0.0
    found = without_zeros(names, lost)[0]
    assert np.isnan(found[:, NAMES.index("LAnkle")]).all() and not np.isnan(found[:, -1]).any()


def test_a_path_that_begins_at_the_origin_keeps_its_first_frame() -> None:
    names = (*NAMES, "Pelvis")
    pelvis = (walk()[:, :1] + walk()[:, 1:2]) / 2
    points = np.concatenate((walk(), pelvis), 1) - pelvis[0]
    assert (points[0, -1] == 0).all() and without_zeros(names, points)[1] == []


def test_rates_as_text(tmp_path: Path) -> None:
    data = {**amass(66), "mocap_framerate": np.array("29.97 fps")}
    assert read_clip(save_npz(tmp_path / "a.npz", data)).fps == 29.97
    path = save_pickle(tmp_path / "b.pkl", {**amass(66), "mocap_framerate": "120"})
    assert read_clip(path, allow_pickle=True).fps == 120.0
    data["mocap_framerate"] = np.array("fast")
    with refused("wrong-type"):
        read_clip(save_npz(tmp_path / "c.npz", data))


def test_blanks_for_tabs_in_a_trc(tmp_path: Path) -> None:
    tabs = read_clip(put(tmp_path, "a.trc", trc(walk())))
    blanks = read_clip(put(tmp_path, "b.trc", trc(walk(), mark="  ")))
    np.testing.assert_array_equal(blanks.positions(), tabs.positions())
    text = trc(walk()).replace("\n30.0\t30.0", "\n30.0 Hz\t30.0", 1)
    assert read_clip(put(tmp_path, "c.trc", text)).fps == 30.0


def test_semicolons_with_decimal_commas(tmp_path: Path) -> None:
    text = csv(walk())
    plain = read_clip(put(tmp_path, "a.csv", text))
    semicolons = read_clip(put(tmp_path, "b.csv", text.replace(",", ";").replace(".", ",")))
    np.testing.assert_array_equal(semicolons.positions(), plain.positions())
    tabs = read_clip(put(tmp_path, "c.csv", text.replace(",", "\t").replace(".", ",")))
    np.testing.assert_array_equal(tabs.positions(), plain.positions())
