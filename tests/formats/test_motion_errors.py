"""Every refusal is one sentence that names the file and the place."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import pytest
from handmade_motion_files import (
    ASF,
    BVH_HEADER,
    amc_text,
    bvh_rows,
    bvh_text,
    deepmimic_row,
    deepmimic_text,
    put,
)

from poise.errors import PoiseError
from poise.formats import read_clip
from poise.formats import text as limits
from refusals import refused


def refusal(path: Path, *told: Any, **options: object) -> str:
    with refused(*told) if told else pytest.raises(PoiseError) as error:
        read_clip(path, **options)  # type: ignore[arg-type]
    message = str(error.value)
    assert message.startswith(str(path)) and "\n" not in message
    return message.removeprefix(str(path))


def rows_with(row: int, column: int, value: str) -> list[str]:
    rows = [r.split() for r in bvh_rows()]
    rows[row][column] = value
    return [" ".join(r) for r in rows]


HEADER = BVH_HEADER
BVH_CASES = {
    "no hierarchy": ("ROOT Hips\n{\n", ("keyword-expected", ("line 1", "HIERARCHY", "ROOT"))),
    "header only": (
        "\n".join(HEADER.splitlines()[:8]),
        ("brace-unmatched", ("line 8", "Spine")),
    ),
    "cut in an offset": (
        "HIERARCHY\nROOT Hips\n{\nOFFSET 1 2",
        ("file-cut-off", ("line 4", "a number")),
    ),
    "no motion": (HEADER, ("file-cut-off",)),
    "no frames": (HEADER + "MOTION\n", ("file-cut-off", "Frames")),
    "no time": (HEADER + "MOTION\nFrames: 3\n", ("file-cut-off", "Frame Time")),
    "bad count": (
        HEADER + "MOTION\nFrames: many\nFrame Time: 0.1\n",
        ("not-a-number", ("line 36", "many")),
    ),
    "bad time": (
        HEADER + "MOTION\nFrames: 3\nFrame Time: 0\n",
        ("rate-out-of-range", ("line 37", "0")),
    ),
    "too few rows": (
        bvh_text(frames=12),
        ("frames-missing", ("line 36", "12", "8")),
    ),
    "one frame": (bvh_text(bvh_rows(1)), ("clip-too-short", "1")),
    "short row": (
        bvh_text([*bvh_rows(3), "1 2 3", *bvh_rows(2)]),
        ("row-width", ("line 41", "3", "18")),
    ),
    "a word": (bvh_text(rows_with(2, 5, "abc")), ("not-a-number", ("line 40", "abc"))),
    "nan": (
        bvh_text(rows_with(2, 10, "nan")),
        ("number-unusable", ("line 40", "Xrotation", "Head")),
    ),
    "inf": (
        bvh_text(rows_with(7, 0, "-inf")),
        ("number-unusable", ("line 45", "Xposition", "Hips")),
    ),
    "huge": (
        bvh_text(rows_with(1, 1, "1e300")),
        ("number-unusable", ("line 39", "Yposition", "Hips")),
    ),
    "bad offset": (
        bvh_text(header=HEADER.replace("OFFSET 0 50 0", "OFFSET 0 fifty 0")),
        ("not-a-number", ("line 8", "fifty")),
    ),
    "twice": (
        bvh_text(header=HEADER.replace("JOINT LeftFoot", "JOINT Head")),
        ("name-repeated", ("line 24", "Head", "10")),
    ),
    "second root": (
        bvh_text(header=HEADER.replace("JOINT LeftLeg", "ROOT LeftLeg")),
        ("line-misplaced", ("line 20", "LeftLeg")),
    ),
    "channel": (
        bvh_text(header=HEADER.replace("Yrotation Xrotation Zrotation", "Yrotation Xscale Zrotation")),
        ("unknown-channel", ("line 13", "Xscale", "Head")),
    ),
    "channel count": (
        bvh_text(header=HEADER.replace("CHANNELS 3 Yrotation", "CHANNELS 30 Yrotation")),
        ("channel-count", ("line 13", "Head", "30")),
    ),
    "no offset": (
        bvh_text(header=HEADER.replace("    OFFSET 0 50 0\n", "")),
        ("part-missing", ("line 6", "Spine", "OFFSET")),
    ),
    "keyword": (
        bvh_text(header=HEADER.replace("JOINT Spine", "BONE Spine")),
        ("unknown-keyword", ("line 6", "BONE")),
    ),
    "no length": (
        bvh_text(header="\n".join(
            "OFFSET 0 0 0" if "OFFSET" in line else line for line in HEADER.splitlines()
        ) + "\n"),
        ("skeleton-without-length",),
    ),
    "binary": (bvh_text().encode() + b"\0\1\2", ("not-text", "line 46")),
    "utf-16": (
        b"\xff\xfe" + bvh_text().encode("utf-16-le"),
        ("not-text", "line 1"),
    ),
    "latin-1": (
        bvh_text(header=HEADER.replace("Hips", "Hüfte")).encode("latin-1"),
        ("not-text", "line 2"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BVH_CASES)
def test_bvh_refusals(tmp_path: Path, case: str) -> None:
    text, message = BVH_CASES[case]
    refusal(put(tmp_path, "a.bvh", text), *message)


AMC = amc_text()
AMC_CASES = {
    "empty": (":DEGREES\n", ("no-frames",)),
    "unknown joint": (
        AMC.replace("\nhead 8.000", "\nhed 8.000"),
        ("unknown-joint", ("line 19", "hed", "7.asf")),
    ),
    "too many values": (
        AMC.replace("\nhead 8.000", "\nhead 8.000 1"),
        ("row-width", ("line 19", "head")),
    ),
    "nan": (
        AMC.replace("\nhead 8.000", "\nhead nan"),
        ("number-unusable", ("line 19", "head", "nan")),
    ),
    "word": (AMC.replace("\nhead 8.000", "\nhead x"), ("not-a-number", ("line 19", "x"))),
    "missing joint": (
        AMC.replace("\nhead 8.000", ""),
        ("frame-incomplete", "line 16"),
    ),
    "doubled joint": (
        AMC.replace("\nhead 8.000", "\nhead 8.000\nhead 8.000"),
        ("name-repeated", ("line 20", "head", "3")),
    ),
    "frame jump": (
        AMC.replace("\n3\n", "\n9\n"),
        ("frames-missing", ("line 16", "9", "2")),
    ),
    "cut": (
        AMC[: AMC.rindex("lfemur")],
        ("frame-incomplete", "line 34"),
    ),
    "one frame": (amc_text(1), ("clip-too-short", "1")),
}


@pytest.mark.parametrize("case", AMC_CASES)
def test_amc_refusals(tmp_path: Path, case: str) -> None:
    put(tmp_path, "7.asf", ASF)
    text, message = AMC_CASES[case]
    refusal(put(tmp_path, "7_01.amc", text), *message)


ASF_CASES = {
    "cut": (ASF[: ASF.index(":hierarchy")], ("part-missing", "hierarchy")),
    "no end": (
        ASF.replace("    limits (-10.0 170.0)\n  end\n", ""),
        ("section-unclosed", ("line 44", "lfoot")),
    ),
    "unknown bone": (
        ASF.replace("spine head\n", "spine hed\n"),
        ("unknown-joint", ("line 56", "hed")),
    ),
    "two parents": (
        ASF.replace("lfemur lfoot\n", "lfemur lfoot head\n"),
        ("second-parent", ("line 57", "head", "lfemur")),
    ),
    "circle": (
        ASF.replace("spine lfemur\n", "spine\n").replace("lfemur lfoot\n", "lfemur lfoot\nlfoot lfemur\n"
        ),
        ("hierarchy-cycle", "lfemur"),
    ),
    "loose": (ASF.replace("    lfemur lfoot\n", ""), ("joint-loose", "lfoot")),
    "twice": (ASF.replace("name lfoot", "name head"), ("name-repeated", ("line 44", "head"))),
    "dof": (
        ASF.replace("dof rx ry rz", "dof rx l rz"),
        ("unknown-channel", ("line 20", "spine", "l")),
    ),
    "limits": (
        ASF.replace("dof rx ry rz", "dof rx ry"),
        ("count-differs", ("line 14", "spine")),
    ),
    "number": (ASF.replace("length 9", "length nine"), ("not-a-number", ("line 18", "nine"))),
}  # fmt: skip


@pytest.mark.parametrize("case", ASF_CASES)
def test_asf_refusals(tmp_path: Path, case: str) -> None:
    text, message = ASF_CASES[case]
    skeleton = put(tmp_path, "7.asf", text)
    with refused(*message) as error:
        read_clip(put(tmp_path, "7_01.amc", AMC))
    assert str(error.value).startswith(str(skeleton))


def row_with(column: int, value: object) -> list[list[float]]:
    rows = [deepmimic_row(t) for t in range(4)]
    rows[2][column] = value  # type: ignore[call-overload]
    return rows


DEEPMIMIC_CASES = {
    "cut": (
        deepmimic_text()[:900],
        ("bad-json", ("line 8", "Expecting ',' delimiter")),
    ),
    "no frames": ('{"Loop": "none"}', ("key-missing",)),
    "empty": ('{"Loop": "none", "Frames": []}', ("no-frames",)),
    "short row": (
        deepmimic_text([deepmimic_row(0), deepmimic_row(1)[:-1]]),
        ("row-width", ("frame 1", "43", "44")),
    ),
    "nan": (
        deepmimic_text(row_with(7, float("nan"))),
        ("number-unusable", ("frame 2", "7", "nan")),
    ),
    "word": (
        deepmimic_text(row_with(7, "x")),
        ("number-unusable", ("frame 2", "7", "x")),
    ),
    "no rotation": (
        deepmimic_text(row_with(8, 7.0)),
        ("not-a-rotation", ("frame 2", "chest", "7")),
    ),
    "duration": (
        deepmimic_text(row_with(0, 0.0)),
        ("out-of-range", ("frame 2", "0")),
    ),
    "loop": (deepmimic_text(loop="maybe"), ("unknown-choice", "maybe")),
    "one frame": (
        deepmimic_text([deepmimic_row(0)]),
        ("clip-too-short", "1"),
    ),
}


@pytest.mark.parametrize("case", DEEPMIMIC_CASES)
def test_deepmimic_refusals(tmp_path: Path, case: str) -> None:
    text, message = DEEPMIMIC_CASES[case]
    refusal(put(tmp_path, "a.txt", text), *message)


def test_files_that_are_no_motion(tmp_path: Path) -> None:
    refusal(tmp_path / "none.bvh", "file-missing")
    refusal(tmp_path, "is-folder")
    refusal(put(tmp_path, "a.bvh", ""), "file-empty")
    for suffix in (".vmd",):
        path = put(tmp_path, f"a{suffix}", b"\1P\2\3")
        refusal(path, "format-not-read", "VMD")
    path = put(tmp_path, "a.xyz", "hello")
    refusal(path, "format-unknown", ".xyz")
    path = put(tmp_path, "a.asf", ASF)
    refusal(path, "skeleton-alone")
    os.mkfifo(tmp_path / "pipe.bvh")
    refusal(tmp_path / "pipe.bvh", "not-a-file")
    lost = tmp_path / "alone"
    lost.mkdir()
    path = put(lost, "1_01.amc", AMC)
    refusal(path, "skeleton-missing")


def test_content_counts_more_than_the_suffix(tmp_path: Path) -> None:
    assert read_clip(put(tmp_path, "a.txt", bvh_text())).skeleton.source.format == "bvh"
    assert read_clip(put(tmp_path, "b", deepmimic_text())).skeleton.source.format == "deepmimic"


def test_absurd_units(tmp_path: Path) -> None:
    path = put(tmp_path, "a.bvh", bvh_text())
    refusal(path, "unit-implausible", ("0.25", "43.5 m", "centimetres"), unit_m=0.25)
    tiny = "\n".join(
        "OFFSET 0 0.002 0" if "OFFSET" in line else line for line in BVH_HEADER.splitlines()
    )
    refusal(
        put(tmp_path, "b.bvh", bvh_text(header=tiny + "\n")),
        "unit-unknown",
        ("0.008696", "metres", "8.7 mm"),
    )


def test_endless_lines_and_huge_files_are_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a.bvh"
    with path.open("wb") as file:
        file.write(b"HIERARCHY\nROOT ")
        for _ in range(6):
            file.write(b"x" * (1 << 20))
    start = time.perf_counter()
    refusal(path, "over-limit", ("line 2", "4.2"))
    with path.open("wb") as file:
        file.write(b"HIERARCHY\n")
        file.truncate(2 << 30)  # Sparse: two gigabytes of zeros that take no disk.
    refusal(path, "file-too-big", ("2.15", "0.54"))
    with path.open("wb") as file:
        file.write(b"HIERARCHY\n")
        file.truncate(limits.MAX_FILE_BYTES)
    refusal(path, "not-text", "line 2")
    assert time.perf_counter() - start < 5.0


def test_a_file_in_the_present_folder_is_named_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cut.bvh").write_text("HIERARCHY\nROOT Hips\n{\n OFFSET 0 0")
    monkeypatch.chdir(tmp_path)
    with refused("file-cut-off", says="cut.bvh, line 4"):
        read_clip(Path("cut.bvh"))
