"""Poise's own npz and CSV: nothing is lost, and damaged files are refused in one sentence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from handmade_motion_files import bvh_text, put
from handmade_numpy_files import odd_clip, save_npz

from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from poise.formats.own import columns
from poise.motion import Clip
from refusals import refused


def check_same(a: Clip, b: Clip) -> None:
    assert a.skeleton == b.skeleton and a.skeleton.source == b.skeleton.source
    assert (a.fps, a.name, a.cyclic) == (b.fps, b.name, b.cyclic)
    np.testing.assert_array_equal(a.rot, b.rot)
    np.testing.assert_array_equal(a.root_pos, b.root_pos)


@pytest.mark.parametrize("name", ["a.npz", "a.poise.npz", "a.csv", "A.NPZ"])
def test_nothing_is_lost(tmp_path: Path, name: str) -> None:
    clip = odd_clip()
    write_clip(clip, tmp_path / name)
    check_same(read_clip(tmp_path / name), clip)
    first = (tmp_path / name).read_bytes()
    write_clip(clip, tmp_path / name)
    assert (tmp_path / name).read_bytes() == first
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("suffix", ["npz", "csv"])
def test_a_detour_leaves_a_bvh_as_it_was(tmp_path: Path, suffix: str) -> None:
    clip = read_clip(put(tmp_path, "a.bvh", bvh_text()))
    write_clip(clip, tmp_path / "direct.bvh")
    write_clip(clip, tmp_path / f"b.{suffix}")
    write_clip(read_clip(tmp_path / f"b.{suffix}"), tmp_path / "detour.bvh")
    assert (tmp_path / "detour.bvh").read_text() == (tmp_path / "direct.bvh").read_text()


@pytest.mark.parametrize("suffix", ["npz", "csv"])
def test_the_content_tells_the_format(tmp_path: Path, suffix: str) -> None:
    write_clip(odd_clip(), tmp_path / f"a.{suffix}")
    (tmp_path / f"a.{suffix}").rename(tmp_path / "a.dat")
    check_same(read_clip(tmp_path / "a.dat"), odd_clip())
    assert read_clip(tmp_path / "a.dat", fps=25).fps == 25.0
    with refused("option-not-applicable", says="--up"):
        read_clip(tmp_path / "a.dat", up_axis="Y")


def test_the_arrays_are_plain(tmp_path: Path) -> None:
    clip = odd_clip()
    write_clip(clip, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as data:
        assert int(data["poise_clip"]) == 1 and tuple(data["names"]) == clip.skeleton.names
        np.testing.assert_array_equal(data["rot"], clip.rot)
        np.testing.assert_array_equal(data["end_joints"], [1, 1, 2])


def arrays(tmp_path: Path) -> dict[str, Any]:
    write_clip(odd_clip(), tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as data:
        return dict(data)


def nan_at(table: np.ndarray, *at: int) -> np.ndarray:
    out = table.copy()
    out[at] = np.nan
    return out


CASES: dict[str, tuple[dict[str, Any], str]] = {
    "newer": (
        {"poise_clip": np.array(2)},
        ("version-unsupported", ("2", "1")),
    ),
    "missing": (
        {"rot": None, "fps": None},
        ("key-missing", "rot"),
    ),
    "shape": (
        {"rot": np.zeros((7, 2, 4))},
        ("wrong-shape", ("rot", "7 x 2 x 4", "7 x 3 x 4")),
    ),
    "text": (
        {"root_pos": np.array([["a", "b", "c"]] * 7)},
        ("wrong-type", ("root_pos", "str32")),
    ),
    "nan": (
        {"rot": nan_at(odd_clip().rot, 4, 1, 2)},
        ("number-unusable", ("4", "nan")),
    ),
    "root nan": (
        {"root_pos": nan_at(odd_clip().root_pos, 6, 0)},
        ("number-unusable", ("6", "nan")),
    ),
    "no rotation": (
        {"rot": odd_clip().rot * np.where(np.arange(7) == 5, 2.0, 1.0)[:, None, None]},
        ("not-a-rotation", ("root", "5", "2")),
    ),
    "no frames": (
        {"root_pos": np.zeros((0, 3)), "rot": np.zeros((0, 3, 4))},
        ("clip-too-short", "0"),
    ),
    "no joints": (
        {"names": np.zeros(0, dtype="U1"), "rot": np.zeros((7, 0, 4)), "parents": np.zeros(0),
         "offsets": np.zeros((0, 3))},
        ("joint-count", ("0", "1500")),
    ),
    "parents": (
        {"parents": np.array([-1, 2, 0])},
        ("parent-order", ("Hüfte, links", "2")),
    ),
    "ends": (
        {"end_joints": np.array([1, 1, 3])},
        ("index-outside",),
    ),
    "counts": (
        {"parents": np.array([-1, 0])},
        ("count-differs", ("3", "2")),
    ),
    "rate": ({"fps": np.array(0.0)}, ("rate-out-of-range", ("0.1", "2000"))),
    "rates": (
        {"fps": np.array([1.0, 2.0])},
        ("wrong-shape", ("fps", "2", "1")),
    ),
    "source": (
        {"source": np.array('{"format": 3}')},
        ("file-damaged",),
    ),
    "json": (
        {"source": np.array("[" * 100000)},
        ("file-damaged", "source"),
    ),
    "twice": (
        {"names": np.array(["a", "b", "a"])},
        ("name-repeated", "a"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_npz_refusals(tmp_path: Path, case: str) -> None:
    changes, message = CASES[case]
    data = {k: v for k, v in {**arrays(tmp_path), **changes}.items() if v is not None}
    if case == "twice":
        data["source"] = np.array('{"format": "bvh"}')
    path = save_npz(tmp_path / "a.npz", data)
    with refused(*message) as error:
        read_clip(path)
    text = str(error.value)
    assert text.startswith(str(path)) and "\n" not in text


def test_unknown_fields_of_a_newer_source_are_left_out(tmp_path: Path) -> None:
    data = arrays(tmp_path)
    text = str(data["source"])[:-1] + ',"invented":[1,2]}'
    save_npz(tmp_path / "a.npz", {**data, "source": np.array(text)})
    check_same(read_clip(tmp_path / "a.npz"), odd_clip())


def csv_lines(tmp_path: Path) -> list[str]:
    write_clip(odd_clip(), tmp_path / "good.csv")
    return (tmp_path / "good.csv").read_text(encoding="utf-8").splitlines()


def csv_refusal(tmp_path: Path, lines: list[str]) -> str:
    path = put(tmp_path, "a.csv", "\n".join(lines) + "\n")
    with pytest.raises(PoiseError) as error:
        read_clip(path)
    text = str(error.value)
    assert text.startswith(str(path)) and "\n" not in text
    return text.removeprefix(str(path))


def test_csv_columns_are_documented_and_may_be_reordered(tmp_path: Path) -> None:
    clip = odd_clip()
    assert columns(clip.skeleton)[:5] == ["time", "root_x", "root_y", "root_z", "root_qw"]
    lines = csv_lines(tmp_path)
    rows = [line.split(",") for line in lines[7:]]
    assert [float(r[0]) for r in rows] == [t / clip.fps for t in range(clip.frames)]
    moved = [*lines[:6], ",".join([*lines[6].split(",")[1:], "time", "remark"])]
    moved += [",".join([*row[1:], row[0], "7"]) for row in rows]
    put(tmp_path, "a.csv", "\r\n".join(moved) + "\r\n")
    check_same(read_clip(tmp_path / "a.csv"), clip)


def test_csv_refusals(tmp_path: Path) -> None:
    lines = csv_lines(tmp_path)
    assert csv_refusal(tmp_path, ["# poise motion csv 9", *lines[1:]]) == (
        ", line 1: the file has version '9' of Poise's CSV; this Poise reads version 1"
    )
    assert csv_refusal(tmp_path, [lines[0], *lines[2:]]) == (
        ": the line '# name:' is missing. Keep the lines with #"
    )
    assert csv_refusal(tmp_path, lines[:5]) == (
        ": the file ends before the column names. The file seems cut off"
    )
    assert csv_refusal(tmp_path, lines[:7]) == ": the file has no frames. The file seems cut off"
    assert csv_refusal(tmp_path, lines[:8]) == ": the clip has 1 frame; motion needs at least 2"
    assert csv_refusal(tmp_path, [*lines[:6], lines[6].replace("root_qx", "root_x2"), *lines[7:]]) == (
        ", line 7: the column 'root_qx' is missing. Did you mean 'root_x'? Known: "
        + ", ".join(n.replace("root_qx", "root_x2") for n in columns(odd_clip().skeleton))
    )
    assert csv_refusal(tmp_path, [*lines[:9], "1,2,3", *lines[9:]]) == (
        ", line 10: the row has 3 values; there are 16 columns"
    )
    row = lines[9].split(",")
    assert csv_refusal(tmp_path, [*lines[:9], ",".join(["x", *row[1:]]), *lines[10:]]) == (
        ", line 10: 'x' is not a number"
    )
    bad = [*row[:9], "nan", *row[10:]]
    assert csv_refusal(tmp_path, [*lines[:9], ",".join(bad), *lines[10:]]) == (
        ": the rotation of joint 'Hüfte, links' at frame 2 is nan, not a usable number"
    )
    assert csv_refusal(tmp_path, [*lines[:9], *lines[10:]]) == (
        ": frame 2 is 0.066 s after the one before it, not 0.033 s. Keep one row per frame"
    )
    broken = [x if not x.startswith("# skeleton") else "# skeleton: {}" for x in lines]
    assert csv_refusal(tmp_path, broken) == (
        ": the skeleton record lacks names, parents, offsets, ends. It is empty"
    )
    slow = [x if not x.startswith("# fps") else "# fps: 0" for x in lines]
    assert csv_refusal(tmp_path, slow).startswith(": the frame rate must be from 0.1 to 2000 per second")
