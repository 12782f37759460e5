"""What `python -m tests.fuzz` has found, each as a small file: refused in one sentence or read."""

from __future__ import annotations

import io
import json
import struct
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from handmade_gltf_files import Gltf, walker
from handmade_numpy_files import odd_clip, poselib, save_npy
from test_opensim_files import mot

from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from refusals import refused


def refusal(path: Path, data: bytes, *told: Any) -> str:
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with refused(*told) if told else pytest.raises(PoiseError) as error:
            read_clip(path, allow_pickle=True)
    message = str(error.value)
    assert message.startswith(str(path)) and message.isprintable()
    return message


@pytest.fixture
def table(tmp_path: Path) -> str:
    write_clip(odd_clip(), tmp_path / "sound.csv")
    return (tmp_path / "sound.csv").read_text()


@pytest.mark.parametrize("uri", [".", "./"])
def test_a_buffer_that_is_a_folder(tmp_path: Path, uri: str) -> None:
    refusal(tmp_path / "a.gltf", walker()[0].gltf(uri).encode(), "file-missing", "buffer")


def test_a_header_without_its_shape(tmp_path: Path) -> None:
    text = b"{'descr': ('<f8',), 'fortran_order': False, 'shape': (2, 3), }\n"
    refusal(tmp_path / "a.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text)


def test_a_number_of_the_record_beyond_all_bounds(tmp_path: Path, table: str) -> None:
    lines = table.splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith("# source:"))
    record = json.loads(lines[at].partition(":")[2])
    record["unit_m"] = 10**400
    lines[at] = "# source: " + json.dumps(record)
    refusal(tmp_path / "a.csv", "\n".join(lines).encode(), "file-damaged")


def test_ends_on_joints_beyond_all_bounds(tmp_path: Path, table: str) -> None:
    lines = table.splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith("# skeleton:"))
    record = json.loads(lines[at].partition(":")[2])
    record["ends"] = [[1e300, 0, 0, 0]]
    lines[at] = "# skeleton: " + json.dumps(record)
    refusal(tmp_path / "a.csv", "\n".join(lines).encode(), "number-unusable")


@pytest.mark.parametrize("data", [b"\xef\xbb\xbf", b"\n", b"\r\n", b" ", b"\xef\xbb\xbf\n"])
def test_a_table_of_nothing(tmp_path: Path, data: bytes) -> None:
    refusal(tmp_path / "a.csv", data)


def test_a_member_whose_name_is_no_text(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("pos\u00e9.npy", b"x")
    data = buffer.getvalue().replace("\u00e9".encode(), b"\xff\xff")
    refusal(tmp_path / "a.npz", data, "file-damaged")


def test_a_signalling_nan_is_no_warning(tmp_path: Path) -> None:
    file: Gltf = walker()[0]
    # Single precision, the top bit of its fraction clear.
    bare = np.frombuffer(bytes(file.data), dtype=np.uint8).copy()
    bare[:4] = np.frombuffer(struct.pack("<I", 0x7F800001), dtype=np.uint8)
    file.data[:] = bare.tobytes()
    refusal(tmp_path / "a.glb", file.glb())


@pytest.mark.parametrize("time", ["inf", "nan", "1e300"])
def test_times_of_opensim_that_are_no_seconds(tmp_path: Path, time: str) -> None:
    data = mot().replace("0.01000000\t", f"{time}\t", 1).encode()
    refusal(tmp_path / "a.mot", data, "times-unusable")


def test_keypoints_that_are_one_place_but_for_an_outlier(tmp_path: Path) -> None:
    still = np.zeros((6, 22, 3))
    still[2, 12] = 1e5, 2e5, 3e5
    np.save(tmp_path / "sound.npy", still)
    said = refusal(tmp_path / "a.npy", (tmp_path / "sound.npy").read_bytes())
    assert "all keypoints lie in one place" in said


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"parents": np.array([-1.0, np.nan, 0.0])},
            ("index-outside", "parents"),
        ),
        (
            {"end_joints": np.array([1e300, 1, 2])},
            ("index-outside", "end_joints"),
        ),
        ({"offsets": np.full((3, 3), 1e-300)}, ("skeleton-without-length",)),
    ],
)
def test_arrays_of_poises_own_that_make_no_body(
    tmp_path: Path, change: dict[str, np.ndarray], said: str
) -> None:
    write_clip(odd_clip(), tmp_path / "sound.poise.npz")
    with np.load(tmp_path / "sound.poise.npz") as file:
        np.savez(tmp_path / "changed.npz", **{**file, **change})
    refusal(tmp_path / "a.npz", (tmp_path / "changed.npz").read_bytes(), *said)


def test_a_note_that_never_ends_is_cut(tmp_path: Path, table: str) -> None:
    assert "One thing." in table
    (tmp_path / "a.csv").write_text(table.replace("One thing.", "One " + "_" * 9000))
    notes = read_clip(tmp_path / "a.csv").skeleton.source.notes
    assert len(notes[0]) == 2000 and notes[0].endswith("_...") and len(notes) == 2


def test_a_shape_beyond_all_numbers(tmp_path: Path) -> None:
    text = b"{'descr': '<f8', 'fortran_order': False, 'shape': (" + b"9" * 400 + b", 3), }\n"
    header = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text
    with zipfile.ZipFile(tmp_path / "sound.npz", "w") as archive:
        for key in ("positions", "names", "fps"):
            archive.writestr(f"{key}.npy", header)
    said = refusal(tmp_path / "a.npz", (tmp_path / "sound.npz").read_bytes())
    assert "1e+09 GB and more than the limit" in said or "more than the limit" in said


def test_a_joint_name_that_no_file_could_hold(tmp_path: Path) -> None:
    motion = poselib()
    names = motion["skeleton_tree"]["node_names"]
    names[1] = "right_\0\1"
    save_npy(tmp_path / "a.npy", motion)
    refusal(tmp_path / "b.npy", (tmp_path / "a.npy").read_bytes(), "not-a-name", "right_")


def test_times_beyond_all_bounds(tmp_path: Path, table: str) -> None:
    line = next(x for x in reversed(table.splitlines()) if x)
    far = table.replace(line, "1e308" + line[line.index(",") :])
    refusal(tmp_path / "a.csv", far.encode(), "times-uneven")
