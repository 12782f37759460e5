"""Units of length and of angles: what fits a person and the format, what cannot be, what is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from handmade_motion_files import ASF, amc_text, bvh_text, deepmimic_row, deepmimic_text, put
from handmade_numpy_files import amass, save_npz
from handmade_people import trc, walk

from poise.formats import read_clip
from poise.formats.guess import guess_unit
from refusals import refused

HOW = "from the bones between head and ankles"


@pytest.mark.parametrize(
    ("height", "unit"),
    [
        (1.67, 1.0), (0.84, 1.0), (167.0, 0.01), (84.0, 0.01), (110.0, 0.01), (230.0, 0.01),
        (1670.0, 0.001), (840.0, 0.001), (65.7, 0.0254), (72.0, 0.0254), (16.7, 0.1), (8.4, 0.1),
        (5.6, 0.3048), (30.0, 0.0254 / 0.45),
    ],
)  # fmt: skip
def test_the_unit_makes_a_person(height: float, unit: float) -> None:
    """Common units win over rare ones where both make a person."""
    assert guess_unit(height, HOW, None, Path("a.bvh")).value == pytest.approx(unit)


@pytest.mark.parametrize(
    ("height", "doubt"),
    [(76.0, "centimetres would make it 0.76 m"), (80.0, "inches would make it 2.03 m"), (167.0, "")],
)
def test_a_doubtful_unit_is_told(height: float, doubt: str) -> None:
    note = guess_unit(height, HOW, None, Path("a.bvh")).note
    assert ("uncertain" in note) == bool(doubt) and doubt in note
    assert ("(--unit " in note) == bool(doubt)


def test_points_in_decimetres(tmp_path: Path) -> None:
    """The same in another format; and decimetres by their name."""
    whole = read_clip(put(tmp_path, "a.trc", trc(walk())))
    text = trc(10 * walk()).replace("\tm\t", "\tfurlong\t")
    guessed = read_clip(put(tmp_path, "b.trc", text))
    stated = read_clip(put(tmp_path, "c.trc", trc(10 * walk()).replace("\tm\t", "\tdm\t")))
    for clip in (guessed, stated):
        np.testing.assert_allclose(clip.positions(), whole.positions(), atol=1e-5)


NAMES = (
    *("time", "pelvis_tilt", "pelvis_list", "pelvis_rotation", "pelvis_tx", "pelvis_ty", "pelvis_tz"),
    *("hip_flexion_r", "hip_flexion_l", "knee_angle_r", "knee_angle_l"),
)


def mot(angles: np.ndarray, turns: np.ndarray, degrees: bool) -> str:
    """An OpenSim table: `angles (T, 4)` of hips and knees, `turns (T)` of the pelvis, as written."""
    time = np.arange(len(angles)) / 50.0
    zero = np.zeros_like(time)
    table = np.stack((time, zero, zero, turns, zero, zero + 0.94, time, *angles.T), 1)
    rows = ["\t".join(f"{v:.6f}" for v in row) for row in table]
    head = ["Coordinates", "version=1", f"inDegrees={'yes' if degrees else 'no'}", "endheader"]
    return "\n".join([*head, "\t".join(NAMES), *rows]) + "\n"


def strides() -> np.ndarray:
    """`(T, 4)` rad: hips by +-0.4, knees by 0 to 1."""
    t = np.arange(60) / 50.0
    swing = 0.4 * np.sin(2 * np.pi * t)
    bend = 0.5 - 0.5 * np.cos(2 * np.pi * t)
    return np.stack((swing, -swing, -bend, bend - 1.0), 1)


def test_angles_that_contradict_what_an_opensim_file_states(tmp_path: Path) -> None:
    """A pelvis may turn round and round; a knee may not, nor may a walker's legs move by 1 degree."""
    turns = np.linspace(0.0, 6 * np.pi, 60)
    good = read_clip(put(tmp_path, "a.mot", mot(strides(), turns, False)))
    also = read_clip(put(tmp_path, "b.mot", mot(np.degrees(strides()), np.degrees(turns), True)))
    np.testing.assert_allclose(also.positions(), good.positions(), atol=1e-6)
    with refused("degrees-as-radians", says=("57.3", "9.1", "inDegrees=no")):
        read_clip(put(tmp_path, "c.mot", mot(np.degrees(strides()), turns, False)))
    with refused("radians-as-degrees", says="inDegrees=yes"):
        read_clip(put(tmp_path, "d.mot", mot(strides(), turns, True)))
    # Who stands nearly still in degrees is no contradiction.
    read_clip(put(tmp_path, "e.mot", mot(0.2 * strides(), turns, True)))


def test_degrees_in_amass_and_deepmimic(tmp_path: Path) -> None:
    data = amass(66)
    data["poses"] = np.degrees(data["poses"])
    with refused("degrees-as-radians"):
        read_clip(save_npz(tmp_path / "a.npz", data))
    rows = [deepmimic_row(t) for t in range(6)]
    # Duration, place, and the quaternions of root, chest, neck and right hip come before the right knee.
    for row in rows:
        row[20] = 52.0
    with refused("degrees-as-radians", says=("right_knee", "52", "8.3")):
        read_clip(put(tmp_path, "b.txt", deepmimic_text(rows)))


def test_amc_and_bvh_in_radians(tmp_path: Path) -> None:
    """AMC without :DEGREES is in its skeleton's unit; BVH in radians is told, since it states none."""
    put(tmp_path, "p.asf", ASF.replace("angle deg", "angle rad"))
    text = amc_text().replace(":DEGREES\n", "")
    assert ":DEGREES" not in text
    with refused("degrees-as-radians", says=":DEGREES"):
        read_clip(put(tmp_path, "p.amc", text))
    t = np.arange(40) / 20.0
    rows = []
    for k in range(len(t)):
        bend, swing = 0.5 + 0.5 * np.sin(6 * t[k]), 0.4 * np.cos(6 * t[k])
        angles = ["0 0 0"] + [f"{swing:.5f} {bend:.5f} 0"] * 5
        rows.append(" ".join([f"0 90 {100 * t[k]:.3f}", *angles]))
    wide = len(bvh_text().splitlines()[-1].split())
    rows = [" ".join(row.split()[:wide]) for row in rows]
    clip = read_clip(put(tmp_path, "a.bvh", bvh_text(rows)))
    assert any("look like radians" in n and "uncertain" in n for n in clip.skeleton.source.notes)
