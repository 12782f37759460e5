"""Mistakes in text files that a hand or a script makes: each sentence names the file and the line."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from handmade_motion_files import ASF, amc_text, bvh_text, deepmimic_row, deepmimic_text, put
from test_opensim_files import mot
from test_points_files import NAMES, trc_text, walking
from test_points_files import csv_text as points_text

from poise.errors import PoiseError
from poise.formats import acclaim as asf_file
from poise.formats import bvh_file, read_clip
from poise.formats import text as text_files

#: What is read, the damage, and what the sentence says behind the file's name.
CASES: dict[str, tuple[str, Callable[[str], str], str]] = {
    "BVH without a number of frames": (
        "a.bvh", lambda t: t.replace("Frames: 8", "Frames:"), "a.bvh, line 36: 'Frames:' has no value"),
    "BVH without a channel": (
        "a.bvh",
        lambda t: re.sub("CHANNELS .*", "CHANNELS 0", t),
        "a.bvh: no joint has any channel, so nothing moves"),
    "ASF that turns twice about an axis": (
        "p.asf", lambda t: t.replace("dof rx rz", "dof rx rx"),
        "p.asf, line 40: bone 'lfemur' names a degree of freedom twice"),
    "ASF with half a limit": (
        "p.asf", lambda t: t.replace("(-45 45)", "(-45)"),
        "p.asf, line 32: limits come in pairs, got 1 numbers"),
    "ASF with bones that are points": (
        "p.asf", lambda t: "\n".join(
            "    length 0" if x.startswith("    length") else x for x in t.split("\n")),
        "p.asf: no bone of the skeleton has any length"),
    "AMC without a root": (
        "p.amc", lambda t: "\n".join(x for x in t.split("\n") if x[:4] != "root"),
        "p.amc: no frame lists the root"),
    "table of keypoints of comments alone": (
        "a.csv", lambda t: "# " + t.replace("\n", "\n# "),
        "a.csv: it is no table of keypoints and no CSV of Poise"),
    "table of keypoints with a vertical of its own": (
        "a.csv", lambda t: "# up = W\n" + t, "a.csv: up must be one of Y, Z, X, -Y, -Z, -X, got 'W'"),
    "TRC of no rate and no times": (
        "a.trc", lambda t: "\n".join(
            x if k < 5 else x.replace(x.split("\t")[1], "", 1) if x else x
            for k, x in enumerate(t.replace("\n30\t30", "\n0\t0").split("\n"))),
        "a.trc, line 3: DataRate is 0 and must be above 0"),
    "TRC of a body that is a point": (
        "a.trc", lambda t: trc_text(np.arange(8)[:, None, None] + np.zeros((8, len(NAMES), 3))),
        "a.trc: all keypoints lie in one place"),
    "TRC with wrists that are never seen at once": (
        "a.trc", lambda t: trc_text(_one_wrist(walking())),
        "a.trc: in no frame are all hips, knees, ankles, shoulders, elbows and wrists seen"),
    "DeepMimic with one frame of hours": (
        "a.txt", lambda t: deepmimic_text([deepmimic_row(k, 1e4 if k == 2 else 0.02) for k in range(6)]),
        "a.txt: its frame durations differ too much to be evened out"),
}  # fmt: skip


def _one_wrist(positions: np.ndarray) -> np.ndarray:
    positions[::2, NAMES.index("RWrist")] = np.nan
    positions[1::2, NAMES.index("LWrist")] = np.nan
    return positions


def sound(name: str) -> str:
    """A sound file of that name."""
    return {
        "a.bvh": bvh_text, "p.asf": lambda: ASF, "p.amc": amc_text, "a.trc": trc_text,
        "a.csv": lambda: points_text(walking()), "a.txt": deepmimic_text, "a.mot": mot,
    }[name]()  # fmt: skip


def refusal(path: Path) -> str:
    with pytest.raises(PoiseError) as error:
        read_clip(path)
    message = str(error.value)
    assert message.startswith(str(path.parent)) and message.isprintable()
    return message.removeprefix(f"{path.parent}/")


@pytest.mark.parametrize("case", CASES)
def test_a_mistake_is_named_with_its_line(tmp_path: Path, case: str) -> None:
    name, change, said = CASES[case]
    put(tmp_path, "p.asf", ASF)
    path = put(tmp_path, name, change(sound(name)))
    if name == "p.asf":
        path = put(tmp_path, "p.amc", amc_text())
    assert refusal(path).startswith(said)


def test_open_limits_of_an_asf_are_whole_turns(tmp_path: Path) -> None:
    put(tmp_path, "p.asf", ASF.replace("(-45 45)", "(-inf 1.#INF)"))
    clip = read_clip(put(tmp_path, "p.amc", amc_text()))
    head = clip.skeleton.source.channels[clip.skeleton.index("head")]
    assert np.allclose(head.limits, [(-np.pi, np.pi)])


def test_blank_lines_and_trailing_tabs_are_passed_over(tmp_path: Path) -> None:
    plain = read_clip(put(tmp_path, "a.trc", trc_text()))
    lines = trc_text().split("\n")
    spread = [f"{line}\t\t\t" if k >= 5 and line else line for k, line in enumerate(lines)]
    again = read_clip(put(tmp_path, "a.trc", "\n".join(spread)))
    assert np.array_equal(plain.rot, again.rot)
    plain = read_clip(put(tmp_path, "a.mot", mot()))
    again = read_clip(put(tmp_path, "a.mot", mot().rstrip("\n").replace("\n0.02", "\n\n0.02") + "\n\n"))
    assert plain.frames == again.frames and np.array_equal(plain.rot, again.rot)


def test_a_stated_rate_goes_before_the_tables(tmp_path: Path) -> None:
    path = put(tmp_path, "a.csv", points_text(walking()))
    assert (read_clip(path).fps, read_clip(path, fps=25.0).fps) == (50.0, 25.0)


def test_limits_of_joints_lines_and_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = put(tmp_path, "a.bvh", bvh_text())
    put(tmp_path, "p.asf", ASF)
    monkeypatch.setattr(bvh_file, "MAX_JOINTS", 3)
    assert refusal(path) == "a.bvh, line 20: more than 3 joints"
    monkeypatch.setattr(bvh_file, "MAX_HEADER_WORDS", 20)
    assert refusal(path) == "a.bvh: no MOTION in the first 20 words"
    monkeypatch.setattr(asf_file, "MAX_JOINTS", 3)
    assert refusal(put(tmp_path, "p.amc", amc_text())).startswith("p.asf, line 34: more than 3 bones")
    monkeypatch.setattr(text_files, "MAX_LINES", 30)
    assert refusal(path) == "a.bvh: the file has more than 30 lines"
