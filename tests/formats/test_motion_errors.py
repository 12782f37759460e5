"""Every refusal is one sentence that names the file and the place; the texts are snapshots."""

from __future__ import annotations

import os
import time
from pathlib import Path

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
from poise.formats.table import READABLE


def refusal(path: Path, **options: object) -> str:
    with pytest.raises(PoiseError) as error:
        read_clip(path, **options)  # type: ignore[arg-type]
    message = str(error.value)
    assert message.startswith(str(path)) and "\n" not in message
    return message.removeprefix(str(path))


def rows_with(row: int, column: int, value: str) -> list[str]:
    rows = [r.split() for r in bvh_rows()]
    rows[row][column] = value
    return [" ".join(r) for r in rows]


HEADER = BVH_HEADER
SEEMS_CUT = "The file seems cut off"
BVH_CASES = {
    "no hierarchy": ("ROOT Hips\n{\n", ", line 1: 'HIERARCHY' was expected, got 'ROOT'"),
    "header only": (
        "\n".join(HEADER.splitlines()[:8]),
        f", line 8: the brace of joint 'Spine' is never closed. {SEEMS_CUT}",
    ),
    "cut in an offset": (
        "HIERARCHY\nROOT Hips\n{\nOFFSET 1 2",
        f", line 4: the file ends where a number was expected. {SEEMS_CUT}",
    ),
    "no motion": (HEADER, f": the file ends before MOTION. {SEEMS_CUT}"),
    "no frames": (HEADER + "MOTION\n", f": the file ends before 'Frames:'. {SEEMS_CUT}"),
    "no time": (HEADER + "MOTION\nFrames: 3\n", f": the file ends before 'Frame Time:'. {SEEMS_CUT}"),
    "bad count": (
        HEADER + "MOTION\nFrames: many\nFrame Time: 0.1\n",
        ", line 36: the number of frames is 'many', which is no whole number",
    ),
    "bad time": (
        HEADER + "MOTION\nFrames: 3\nFrame Time: 0\n",
        ", line 37: the frame time is 0 s, which must be above 0",
    ),
    "too few rows": (
        bvh_text(frames=12),
        f", line 36: 12 frames are stated, but only 8 rows follow. {SEEMS_CUT}",
    ),
    "one frame": (bvh_text(bvh_rows(1)), ": the clip has 1 frame; motion needs at least 2"),
    "short row": (
        bvh_text([*bvh_rows(3), "1 2 3", *bvh_rows(2)]),
        ", line 41: the row of frame 3 has 3 numbers; the channels need 18",
    ),
    "a word": (bvh_text(rows_with(2, 5, "abc")), ", line 40: 'abc' is not a number"),
    "nan": (
        bvh_text(rows_with(2, 10, "nan")),
        ", line 40: Xrotation of joint 'Head' at frame 2 is nan, not a finite number",
    ),
    "inf": (
        bvh_text(rows_with(7, 0, "-inf")),
        ", line 45: Xposition of joint 'Hips' at frame 7 is -inf, not a finite number",
    ),
    "huge": (
        bvh_text(rows_with(1, 1, "1e300")),
        ", line 39: Yposition of joint 'Hips' at frame 1 is 1e+300, larger than 1e+08",
    ),
    "bad offset": (
        bvh_text(header=HEADER.replace("OFFSET 0 50 0", "OFFSET 0 fifty 0")),
        ", line 8: 'fifty' is not a number",
    ),
    "twice": (
        bvh_text(header=HEADER.replace("JOINT LeftFoot", "JOINT Head")),
        ", line 24: joint name 'Head' appears twice (first in line 10). Rename one of them",
    ),
    "second root": (
        bvh_text(header=HEADER.replace("JOINT LeftLeg", "ROOT LeftLeg")),
        ", line 20: ROOT 'LeftLeg' stands inside a joint",
    ),
    "channel": (
        bvh_text(header=HEADER.replace("Yrotation Xrotation Zrotation", "Yrotation Xscale Zrotation")),
        ", line 13: 'Xscale' is not a channel of joint 'Head'. Known: Xposition, Yposition, Zposition, "
        "Xrotation, Yrotation, Zrotation",
    ),
    "channel count": (
        bvh_text(header=HEADER.replace("CHANNELS 3 Yrotation", "CHANNELS 30 Yrotation")),
        ", line 13: joint 'Head' must have 0 to 6 channels, got '30'",
    ),
    "no offset": (
        bvh_text(header=HEADER.replace("    OFFSET 0 50 0\n", "")),
        ", line 6: joint 'Spine' has no OFFSET",
    ),
    "keyword": (
        bvh_text(header=HEADER.replace("JOINT Spine", "BONE Spine")),
        ", line 6: 'BONE' is not a BVH keyword. Known: ROOT, JOINT, End Site, OFFSET, CHANNELS, MOTION",
    ),
    "no length": (
        bvh_text(header="\n".join(
            "OFFSET 0 0 0" if "OFFSET" in line else line for line in HEADER.splitlines()
        ) + "\n"),
        ": no bone of the skeleton has any length (all offsets are zero)",
    ),
    "binary": (bvh_text().encode() + b"\0\1\2", ", line 46: binary data in a text file"),
    "utf-16": (
        b"\xff\xfe" + bvh_text().encode("utf-16-le"),
        ", line 1: the text is encoded as UTF-16. Save it as UTF-8",
    ),
    "latin-1": (
        bvh_text(header=HEADER.replace("Hips", "Hüfte")).encode("latin-1"),
        ", line 2: byte 0xfc is not UTF-8 text. Save it as UTF-8",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BVH_CASES)
def test_bvh_refusals(tmp_path: Path, case: str) -> None:
    text, message = BVH_CASES[case]
    assert refusal(put(tmp_path, "a.bvh", text)) == message


AMC = amc_text()
AMC_CASES = {
    "empty": (":DEGREES\n", f": the file has no frames. {SEEMS_CUT}"),
    "unknown joint": (
        AMC.replace("\nhead 8.000", "\nhed 8.000"),
        ", line 19: joint 'hed' is not in the skeleton 7.asf. Did you mean 'head'? Known: root, spine, "
        "head, lfemur, lfoot",
    ),
    "too many values": (
        AMC.replace("\nhead 8.000", "\nhead 8.000 1"),
        ", line 19: joint 'head' at frame 3 has 2 values, but its skeleton gives it 1. Is it the right "
        "skeleton? Name another with --skeleton FILE",
    ),
    "nan": (
        AMC.replace("\nhead 8.000", "\nhead nan"),
        ", line 19: joint 'head' at frame 3 has the unusable value nan",
    ),
    "word": (AMC.replace("\nhead 8.000", "\nhead x"), ", line 19: 'x' is not a number"),
    "missing joint": (
        AMC.replace("\nhead 8.000", ""),
        ", line 16: frame 3 lists 4 joints, but the first frame 5. The file seems damaged or cut off",
    ),
    "doubled joint": (
        AMC.replace("\nhead 8.000", "\nhead 8.000\nhead 8.000"),
        ", line 20: joint 'head' appears twice in frame 3",
    ),
    "frame jump": (
        AMC.replace("\n3\n", "\n9\n"),
        ", line 16: frame 9 follows frame 2, so frames are missing or doubled",
    ),
    "cut": (
        AMC[: AMC.rindex("lfemur")],
        ", line 34: frame 6 lists 3 joints, but the first frame 5. The file seems damaged or cut off",
    ),
    "one frame": (amc_text(1), ": the clip has 1 frame; motion needs at least 2"),
}


@pytest.mark.parametrize("case", AMC_CASES)
def test_amc_refusals(tmp_path: Path, case: str) -> None:
    put(tmp_path, "7.asf", ASF)
    text, message = AMC_CASES[case]
    assert refusal(put(tmp_path, "7_01.amc", text)) == message


ASF_CASES = {
    "cut": (ASF[: ASF.index(":hierarchy")], f": the skeleton has no :hierarchy section. {SEEMS_CUT}"),
    "no end": (
        ASF.replace("    limits (-10.0 170.0)\n  end\n", ""),
        f", line 44: bone 'lfoot' has no 'end'. {SEEMS_CUT}",
    ),
    "unknown bone": (
        ASF.replace("spine head\n", "spine hed\n"),
        ", line 56: there is no bone 'hed'. Did you mean 'head'? Known: root, spine, head, lfemur, "
        "lfoot",
    ),
    "two parents": (
        ASF.replace("lfemur lfoot\n", "lfemur lfoot head\n"),
        ", line 57: bone 'head' is given a second parent, 'lfemur'",
    ),
    "circle": (
        ASF.replace("spine lfemur\n", "spine\n").replace("lfemur lfoot\n", "lfemur lfoot\nlfoot lfemur\n"
        ),
        ": the :hierarchy runs in a circle at bone 'lfemur'",
    ),
    "loose": (ASF.replace("    lfemur lfoot\n", ""), ": bone 'lfoot' has no place in the :hierarchy"),
    "twice": (ASF.replace("name lfoot", "name head"), ", line 44: bone name 'head' appears twice"),
    "dof": (
        ASF.replace("dof rx ry rz", "dof rx l rz"),
        ", line 20: bone 'spine' has the degree of freedom 'l'; only rx, ry and rz can be read",
    ),
    "limits": (
        ASF.replace("dof rx ry rz", "dof rx ry"),
        ", line 14: bone 'spine' has 2 degrees of freedom but 3 limits",
    ),
    "number": (ASF.replace("length 9", "length nine"), ", line 18: 'nine' is not a number"),
}  # fmt: skip


@pytest.mark.parametrize("case", ASF_CASES)
def test_asf_refusals(tmp_path: Path, case: str) -> None:
    text, message = ASF_CASES[case]
    skeleton = put(tmp_path, "7.asf", text)
    with pytest.raises(PoiseError) as error:
        read_clip(put(tmp_path, "7_01.amc", AMC))
    assert str(error.value) == f"{skeleton}{message}"


def row_with(column: int, value: object) -> list[list[float]]:
    rows = [deepmimic_row(t) for t in range(4)]
    rows[2][column] = value  # type: ignore[call-overload]
    return rows


DEEPMIMIC_CASES = {
    "cut": (
        deepmimic_text()[:900],
        f", line 8: this is not valid JSON (Expecting ',' delimiter). {SEEMS_CUT}",
    ),
    "no frames": ('{"Loop": "none"}', ": the JSON has no list named 'Frames'. DeepMimic files need one"),
    "empty": ('{"Loop": "none", "Frames": []}', ": the list 'Frames' is empty"),
    "short row": (
        deepmimic_text([deepmimic_row(0), deepmimic_row(1)[:-1]]),
        ", frame 1: it has 43 numbers, not 44",
    ),
    "nan": (
        deepmimic_text(row_with(7, float("nan"))),
        ", frame 2: column 7 holds 'nan', no usable number",
    ),
    "word": (
        deepmimic_text(row_with(7, "x")),
        ", frame 2: column 7 holds 'x', no usable number",
    ),
    "no rotation": (
        deepmimic_text(row_with(8, 7.0)),
        ", frame 2: the quaternion of joint 'chest' has length 7, no rotation",
    ),
    "duration": (
        deepmimic_text(row_with(0, 0.0)),
        ", frame 2: its duration is 0 s, which must be above 0",
    ),
    "loop": (deepmimic_text(loop="maybe"), ": Loop must be wrap or none, got 'maybe'"),
    "one frame": (
        deepmimic_text([deepmimic_row(0)]),
        ": the clip has 1 frame; motion needs at least 2",
    ),
}


@pytest.mark.parametrize("case", DEEPMIMIC_CASES)
def test_deepmimic_refusals(tmp_path: Path, case: str) -> None:
    text, message = DEEPMIMIC_CASES[case]
    assert refusal(put(tmp_path, "a.txt", text)) == message


def test_files_that_are_no_motion(tmp_path: Path) -> None:
    assert refusal(tmp_path / "none.bvh") == ": there is no such file"
    assert refusal(tmp_path) == ": this is a folder, not a motion file. Name one file in it"
    assert refusal(put(tmp_path, "a.bvh", "")) == ": the file is empty"
    for suffix, name in ((".vmd", "VMD"),):
        path = put(tmp_path, f"a{suffix}", b"\1P\2\3")
        assert refusal(path) == f": {name} files are not read yet. {READABLE}"
    path = put(tmp_path, "a.xyz", "hello")
    assert (
        refusal(path)
        == f": the suffix '.xyz' and its content belong to no known motion format. {READABLE}"
    )
    path = put(tmp_path, "a.asf", ASF)
    assert (
        refusal(path)
        == ": an ASF file holds a skeleton without motion. Give the AMC file, with --skeleton FILE"
    )
    os.mkfifo(tmp_path / "pipe.bvh")
    assert refusal(tmp_path / "pipe.bvh") == ": this is not a regular file"
    lost = tmp_path / "alone"
    lost.mkdir()
    path = put(lost, "1_01.amc", AMC)
    assert (
        refusal(path)
        == ": no ASF skeleton lies beside this AMC file. Name its skeleton with --skeleton FILE"
    )


def test_content_counts_more_than_the_suffix(tmp_path: Path) -> None:
    assert read_clip(put(tmp_path, "a.txt", bvh_text())).skeleton.source.format == "bvh"
    assert read_clip(put(tmp_path, "b", deepmimic_text())).skeleton.source.format == "deepmimic"


def test_absurd_units(tmp_path: Path) -> None:
    path = put(tmp_path, "a.bvh", bvh_text())
    assert refusal(path, unit_m=0.25) == (
        ": with 0.25 m per unit the person would be 43.5 m tall. Give another --unit METRES_PER_UNIT; "
        "centimetres (0.01) would make it 1.74 m"
    )
    tiny = "\n".join(
        "OFFSET 0 0.002 0" if "OFFSET" in line else line for line in BVH_HEADER.splitlines()
    )
    assert refusal(put(tmp_path, "b.bvh", bvh_text(header=tiny + "\n"))) == (
        ": the person is 0.008696 file units tall, which is no human size in any known unit: the "
        "nearest guess, metres, makes it 8.7 mm. State the unit with --unit METRES_PER_UNIT"
    )


def test_endless_lines_and_huge_files_are_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a.bvh"
    with path.open("wb") as file:
        file.write(b"HIERARCHY\nROOT ")
        for _ in range(6):
            file.write(b"x" * (1 << 20))
    start = time.perf_counter()
    assert refusal(path) == ", line 2: the line is longer than 4.2 MB, which no frame needs"
    with path.open("wb") as file:
        file.write(b"HIERARCHY\n")
        file.truncate(2 << 30)  # Sparse: two gigabytes of zeros that take no disk.
    assert refusal(path) == (
        ": the file has 2.15 GB, more than the limit of 0.54 GB. Cut it into shorter clips"
    )
    with path.open("wb") as file:
        file.write(b"HIERARCHY\n")
        file.truncate(limits.MAX_FILE_BYTES)
    assert refusal(path) == ", line 2: binary data in a text file"
    assert time.perf_counter() - start < 5.0


def test_a_file_in_the_present_folder_is_named_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cut.bvh").write_text("HIERARCHY\nROOT Hips\n{\n OFFSET 0 0")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(PoiseError, match=r"^cut\.bvh, line 4: "):
        read_clip(Path("cut.bvh"))
