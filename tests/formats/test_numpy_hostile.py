"""NumPy files that are cut, lie about their size or hold something else: one sentence each."""

from __future__ import annotations

import io
import pickle
import random
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from handmade_motion_files import put
from handmade_numpy_files import amass, odd_clip, save_npz
from numpy.lib import format as npy

from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from poise.formats.arrays import MAX_ARRAY_BYTES, Archive, npz_bytes
from refusals import refused


def refusal(path: Path, *told: Any, **options: Any) -> str:
    start = time.perf_counter()
    with refused(*told) if told else pytest.raises(PoiseError) as error:
        read_clip(path, **options)
    text = str(error.value)
    assert text.startswith(str(path)) and "\n" not in text
    assert time.perf_counter() - start < 5.0
    return text.removeprefix(str(path))


def without(data: dict[str, Any], *keys: str) -> dict[str, Any]:
    return {k: v for k, v in data.items() if k not in keys}


def with_nan(width: int, frame: int, column: int) -> dict[str, Any]:
    data = amass(width)
    data["poses"][frame, column] = np.nan
    return data


AMASS: dict[str, tuple[dict[str, Any], str]] = {
    "no trans": (
        without(amass(), "trans"),
        ("key-missing", "trans"),
    ),
    "a slip of the pen": (
        {**without(amass(), "trans"), "tran": np.zeros((12, 3))},
        ("key-missing", "trans"),
    ),
    "width": (
        {**amass(), "poses": np.zeros((12, 150))},
        ("layout-unknown", ("poses", "150")),
    ),
    "axes": (
        {**amass(), "poses": np.zeros(12)},
        ("wrong-shape", ("poses", "12", "any x any")),
    ),
    "frames": ({**amass(), "trans": np.zeros((9, 3))}, ("length-differs", ("12", "9"))),
    "no frames": (
        {**amass(), "poses": np.zeros((0, 156)), "trans": np.zeros((0, 3))},
        ("clip-too-short", "0"),
    ),
    "one frame": (amass(frames=1), ("clip-too-short", "1")),
    "nan": (
        with_nan(156, 7, 3 * 18 + 1),
        ("number-unusable", ("left_elbow", "7", "nan")),
    ),
    "inf": (
        {**amass(), "trans": np.full((12, 3), np.inf)},
        ("number-unusable", ("the translation", "0", "inf")),
    ),
    "text": (
        {**amass(), "poses": np.full((12, 156), "x")},
        ("wrong-type", ("poses", "str32")),
    ),
    "no rate": (
        without(amass(), "mocap_framerate"),
        ("rate-missing",),
    ),
    "bad rate": (
        {**amass(), "mocap_framerate": np.array(0)},
        ("rate-out-of-range", ("0.1", "2000", "0")),
    ),
    "nan rate": (
        {**amass(), "mocap_framerate": np.array(np.nan)},
        ("not-finite", ("mocap_framerate", "nan")),
    ),
    "no motion": (
        {"weights": np.zeros(3)},
        ("layout-unknown", ("weights", "Poise")),
    ),
    "robot": (
        {"qpos": np.zeros((5, 36))},
        ("robot-motion",),
    ),
}


@pytest.mark.parametrize("case", AMASS)
def test_amass_refusals(tmp_path: Path, case: str) -> None:
    data, message = AMASS[case]
    refusal(save_npz(tmp_path / "a.npz", data), *message)


def forged(path: Path, key: str, header: dict[str, Any], data: bytes, method: int = 0) -> Path:
    """A good AMASS file in which one array's header and data are replaced."""
    good = npz_bytes(without(amass(66), key))
    out = io.BytesIO(good)
    with zipfile.ZipFile(out, "a", method) as archive:
        stream = io.BytesIO()
        npy.write_array_header_2_0(stream, header)
        archive.writestr(f"{key}.npy", stream.getvalue() + data)
    path.write_bytes(out.getvalue())
    return path


def header_of(shape: tuple[int, ...], descr: str = "<f8") -> dict[str, Any]:
    return {"descr": descr, "fortran_order": False, "shape": shape}


def test_sizes_that_are_stated_are_not_believed(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    forged(path, "poses", header_of((10**10, 66)), b"")
    refusal(path, "file-too-big", ("poses", "10000000000, 66", "5.28e+03"))
    forged(path, "poses", header_of((10**30, 0)), b"")
    assert "array 'poses'" in refusal(path)
    forged(path, "poses", header_of((12, 66)), bytes(100))
    refusal(path, "file-cut-off", ("poses", "12, 66", "6336"))
    forged(path, "poses", header_of((-3, 66)), b"")
    refusal(path, "file-damaged")
    forged(path, "poses", header_of((2, 66), "|V500000000000"), b"")
    assert "array 'poses'" in refusal(path)


def test_characters_that_do_not_exist_are_refused(tmp_path: Path) -> None:
    path = forged(tmp_path / "a.npz", "gender", header_of((), "<U1"), (0x110000).to_bytes(4, "little"))
    refusal(path, "file-damaged", "gender")
    data = pickle.dumps({"poses": np.array(["x"])}).replace(b"x\0\0\0", b"\0\0\x11\0")
    refusal(put(tmp_path, "a.pkl", data), "file-damaged", allow_pickle=True)


def test_a_zip_bomb_is_left_unpacked(tmp_path: Path) -> None:
    # 40 MB of zeros in 40 kB, behind a header that states 6 kB.
    path = tmp_path / "a.npz"
    forged(path, "poses", header_of((12, 66)), bytes(40 << 20), zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 1 << 20
    refusal(path, "file-cut-off", ("poses", "12, 66", "6336"))
    assert MAX_ARRAY_BYTES < 1 << 30


def test_cut_and_damaged_archives(tmp_path: Path) -> None:
    whole = npz_bytes(amass(66))
    for size in (40, 200, 3000, len(whole) - 10):
        refusal(put(tmp_path, "a.npz", whole[:size]), "file-damaged")
    at = whole.index(b"poses.npy") + 2000
    flipped = whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :]
    refusal(put(tmp_path, "a.npz", flipped), "file-damaged")
    other = io.BytesIO()
    with zipfile.ZipFile(other, "w") as archive:
        archive.writestr("readme.txt", "hello")
    refusal(put(tmp_path, "a.npz", other.getvalue()), "format-not-read", "zip")
    refusal(put(tmp_path, "b.npz", b"hello, this is no zip"), "file-damaged")


def test_single_arrays_and_robots_are_named(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((20, 23, 3)))
    refusal(tmp_path / "a.npy", "array-unclear")
    for shape, message in (
        ((60, 263), "holds the features of HumanML3D, but normalised or empty. Give features * Std"),
        ((5, 20, 22, 3), "holds 5 clips. Save each as a file of its own"),
        ((5, 20, 24, 3), "holds 5 clips"),
        ((20, 66), "may be joints of shape (20, 22, 3), flattened. If so, save it with reshape(20, 22,"),
        ((20, 72), "may be joints of shape (20, 24, 3)"),
    ):
        np.save(tmp_path / "a.npy", np.zeros(shape))
        assert message in refusal(tmp_path / "a.npy")
    row = "0,0,0.8,1,0,0,0," + ",".join(["0.1"] * 29)
    refusal(put(tmp_path, "a.csv", "\n".join([row] * 5)), "robot-motion", ("36", "29"))
    refusal(put(tmp_path, "a.h5", b"\x89HDF\r\n\x1a\n" + bytes(100)), "robot-motion")


def test_real_robot_files_are_named(data_dir: Path) -> None:
    for name in ("text_to_motion/kimodo_g1_walk.csv", "dm_control/test_trajectories.h5"):
        refusal(data_dir / "other" / name, "robot-motion")


def test_an_archive_is_a_mapping_that_reads_late(tmp_path: Path) -> None:
    data = amass(72)
    archive = Archive(save_npz(tmp_path / "a.npz", data))
    assert set(archive) == set(data) and "poses" in archive and len(archive) == len(data)
    assert archive.header("poses").shape == (12, 72)
    np.testing.assert_array_equal(archive["poses"], data["poses"])
    turned = np.asfortranarray(data["trans"])
    archive = Archive(save_npz(tmp_path / "b.npz", {"a": turned}))
    np.testing.assert_array_equal(archive["a"], turned)
    with pytest.raises(KeyError):
        archive["b"]


def test_damaged_files_are_refused_or_read_but_never_crash(tmp_path: Path) -> None:
    write_clip(odd_clip(), tmp_path / "p.npz")
    write_clip(odd_clip(), tmp_path / "p.csv")
    whole = {
        "a.npz": npz_bytes(amass(66)),
        "b.npz": (tmp_path / "p.npz").read_bytes(),
        "c.csv": (tmp_path / "p.csv").read_bytes(),
    }
    rng = random.Random(5)
    read = 0
    for _ in range(300):
        name = rng.choice(list(whole))
        data = bytearray(whole[name])
        for _ in range(rng.randint(1, 8)):
            data[rng.randrange(len(data))] = rng.randrange(256)
        cut = rng.random() < 0.3
        path = put(tmp_path, name, bytes(data[: rng.randrange(len(data))] if cut else data))
        try:
            read_clip(path)
            read += 1
        except PoiseError as error:
            assert "\n" not in str(error) and name in str(error)
    assert 0 < read < 300
