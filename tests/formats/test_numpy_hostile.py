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


def refusal(path: Path, **options: Any) -> str:
    start = time.perf_counter()
    with pytest.raises(PoiseError) as error:
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
        ": this motion of the SMPL family lacks trans. Did you mean 'betas'? Known: poses, betas, "
        "gender, mocap_framerate, dmpls",
    ),
    "a slip of the pen": (
        {**without(amass(), "trans"), "tran": np.zeros((12, 3))},
        ": this motion of the SMPL family lacks trans. Did you mean 'tran'? Known: poses, betas, "
        "gender, mocap_framerate, dmpls, tran",
    ),
    "width": (
        {**amass(), "poses": np.zeros((12, 150))},
        ": array 'poses' has 150 numbers a frame, which is no layout of SMPL. Known: 66 (SMPL body), 72 "
        "(SMPL), 156 (SMPL-H), 165 (SMPL-X)",
    ),
    "axes": (
        {**amass(), "poses": np.zeros(12)},
        ", array 'poses': it has the shape 12, not any x any",
    ),
    "frames": ({**amass(), "trans": np.zeros((9, 3))}, ": it has 12 poses but 9 translations"),
    "no frames": (
        {**amass(), "poses": np.zeros((0, 156)), "trans": np.zeros((0, 3))},
        ": the clip has 0 frames; motion needs at least 2",
    ),
    "one frame": (amass(frames=1), ": the clip has 1 frame; motion needs at least 2"),
    "nan": (
        with_nan(156, 7, 3 * 18 + 1),
        ": the rotation of joint 'left_elbow' at frame 7 is nan, not a usable number",
    ),
    "inf": (
        {**amass(), "trans": np.full((12, 3), np.inf)},
        ": the translation at frame 0 is inf, not a usable number",
    ),
    "text": (
        {**amass(), "poses": np.full((12, 156), "x")},
        ", array 'poses': it holds str32 values, not numbers",
    ),
    "no rate": (
        without(amass(), "mocap_framerate"),
        ": the file states no frame rate (none of mocap_framerate, mocap_frame_rate, frame_rate, "
        "framerate, fps). State it with --fps F",
    ),
    "bad rate": (
        {**amass(), "mocap_framerate": np.array(0)},
        ": the frame rate must be from 0.1 to 2000 per second, got 0. State the right one with --fps F",
    ),
    "nan rate": (
        {**amass(), "mocap_framerate": np.array(np.nan)},
        ", array 'mocap_framerate': it holds nan, not a finite number",
    ),
    "no motion": (
        {"weights": np.zeros(3)},
        ": its arrays are no motion that is known ('weights'). Known: Poise's own arrays; AMASS and the "
        "SMPL family (poses, trans); Kimodo (posed_joints); poselib (skeleton_tree, rotation); "
        "keypoints (positions, names, fps); MDM (motion, lengths); joints, fps; OpenSim "
        "coordinates (q_hip_flexion_r, ...)",
    ),
    "robot": (
        {"qpos": np.zeros((5, 36))},
        ": it holds the joint angles of a robot (qpos), which mean nothing without the robot's model. "
        "Give the human motion it was made from",
    ),
}


@pytest.mark.parametrize("case", AMASS)
def test_amass_refusals(tmp_path: Path, case: str) -> None:
    data, message = AMASS[case]
    assert refusal(save_npz(tmp_path / "a.npz", data)) == message


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
    assert refusal(path) == (
        ", array 'poses': it states the shape (10000000000, 66), which is 5.28e+03 GB and more than the "
        "limit of 0.54 GB. Cut it into shorter clips"
    )
    forged(path, "poses", header_of((10**30, 0)), b"")
    assert "array 'poses'" in refusal(path)
    forged(path, "poses", header_of((12, 66)), bytes(100))
    assert refusal(path) == (
        ", array 'poses': it states the shape (12, 66) of 6336 bytes, but only 100 are there. The file "
        "seems cut off"
    )
    forged(path, "poses", header_of((-3, 66)), b"")
    assert ": its NumPy header" in refusal(path)
    forged(path, "poses", header_of((2, 66), "|V500000000000"), b"")
    assert "array 'poses'" in refusal(path)


def test_characters_that_do_not_exist_are_refused(tmp_path: Path) -> None:
    path = forged(tmp_path / "a.npz", "gender", header_of((), "<U1"), (0x110000).to_bytes(4, "little"))
    assert refusal(path) == (
        ", array 'gender': it holds characters that do not exist. The file seems cut off"
    )
    data = pickle.dumps({"poses": np.array(["x"])}).replace(b"x\0\0\0", b"\0\0\x11\0")
    assert "characters that do not e" in refusal(put(tmp_path, "a.pkl", data), allow_pickle=True)


def test_a_zip_bomb_is_left_unpacked(tmp_path: Path) -> None:
    # 40 MB of zeros in 40 kB, behind a header that states 6 kB.
    path = tmp_path / "a.npz"
    forged(path, "poses", header_of((12, 66)), bytes(40 << 20), zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 1 << 20
    assert refusal(path) == (
        ", array 'poses': it states the shape (12, 66) of 6336 bytes, but more are there. The file "
        "seems cut off"
    )
    assert MAX_ARRAY_BYTES < 1 << 30


def test_cut_and_damaged_archives(tmp_path: Path) -> None:
    whole = npz_bytes(amass(66))
    for size in (40, 200, 3000, len(whole) - 10):
        assert "the NumPy archive is damaged" in refusal(put(tmp_path, "a.npz", whole[:size]))
    at = whole.index(b"poses.npy") + 2000
    flipped = whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :]
    assert "damaged ('Bad CRC-32 for file" in refusal(put(tmp_path, "a.npz", flipped))
    other = io.BytesIO()
    with zipfile.ZipFile(other, "w") as archive:
        archive.writestr("readme.txt", "hello")
    assert refusal(put(tmp_path, "a.npz", other.getvalue())).startswith(": zip files are not read yet")
    assert "the NumPy archive is damaged" in refusal(put(tmp_path, "b.npz", b"hello, this is no zip"))


def test_single_arrays_and_robots_are_named(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((20, 23, 3)))
    assert refusal(tmp_path / "a.npy") == (
        ": it holds one array of shape (20, 23, 3) without joint names or a frame rate. Joints of SMPL "
        "are (T, 22, 3) or (T, 24, 3); save others as npz with named arrays"
    )
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
    assert refusal(put(tmp_path, "a.csv", "\n".join([row] * 5))) == (
        ": its rows of 36 numbers are a robot's root pose and 29 joint angles (qpos), which mean "
        "nothing without the robot's model. Give the human motion it was made from"
    )
    assert "HDF5" in refusal(put(tmp_path, "a.h5", b"\x89HDF\r\n\x1a\n" + bytes(100)))


def test_real_robot_files_are_named(data_dir: Path) -> None:
    for name in ("text_to_motion/kimodo_g1_walk.csv", "dm_control/test_trajectories.h5"):
        assert "mean nothing" in refusal(data_dir / "other" / name)


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
