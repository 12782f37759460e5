"""Mistakes in files of arrays (npz, npy, pickles, C3D): each sentence names the file and the array."""

from __future__ import annotations

import pickle
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from handmade_numpy_files import aist, amass, odd_clip, poselib, save_npy, save_npz, save_pickle
from test_points_files import NAMES, walking, write_c3d

from poise.errors import PoiseError
from poise.formats import arrays as array_files
from poise.formats import c3d, pickles, read_clip, write_clip
from poise.formats.arrays import directory_bytes
from refusals import refused


def refusal(path: Path, *told: Any) -> str:
    with refused(*told) if told else pytest.raises(PoiseError) as error:
        read_clip(path, allow_pickle=True)
    message = str(error.value)
    assert message.startswith(str(path)) and message.isprintable()
    return message.removeprefix(str(path))


def keys(**more: Any) -> dict[str, Any]:
    """A file of keypoints."""
    return {"positions": walking(), "names": np.array(NAMES), "fps": np.array(30.0), **more}


def gvhmr(hands: int) -> dict[str, Any]:
    """Poses in parts, with `hands` frames of hands."""
    data = amass(66)
    return {
        "root_orient": data["poses"][:, :3], "pose_body": data["poses"][:, 3:],
        "pose_hand": np.zeros((hands, 90)), "trans": data["trans"], "mocap_framerate": 60.0,
    }  # fmt: skip


def mdm(**more: Any) -> dict[str, Any]:
    """Two motions of a generator, 30 cm apart."""
    points = np.random.default_rng(0).normal(size=(22, 3))
    points[:, 1] = np.linspace(0, 1.7, 22)
    one = points[..., None] + 0.01 * np.arange(6)
    return {"motion": np.stack((one, one + 0.3)), "lengths": np.array([6, 4]), **more}


CASES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "unit below 0": (
        lambda f: save_npz(f / "a.npz", keys(unit_m=-1.0)), ("out-of-range", "-1")),
    "up W": (
        lambda f: save_npz(f / "a.npz", keys(up_axis=b"W")),
        ("unknown-axis", ("Y, Z, X, -Y, -Z, -X", "W")),
    ),
    "poses of two lengths": (
        lambda f: save_npz(f / "a.npz", gvhmr(5)), ("length-differs", "12, 12, 5")),
    "a scaling of 0": (
        lambda f: save_pickle(f / "a.pkl", {**aist(), "smpl_scaling": np.zeros(1)}),
        ("out-of-range", "0")),
    "a tree that is a number": (
        lambda f: save_npy(f / "a.npy", {**poselib(), "skeleton_tree": 3}),
        ("wrong-type",)),
    "names that are numbers": (
        lambda f: save_npy(f / "a.npy", _tree(node_names=[1, 2])),
        ("wrong-type",)),
    "no names": (
        lambda f: save_npy(f / "a.npy", _tree(node_names=[])),
        ("joint-count", ("0", "1500"))),
    "a list of two dicts": (
        lambda f: save_pickle(f / "a.pkl", [{"a": 1}, {"a": 2}]),
        ("wrong-type", "list")),
    "a type among the data": (
        lambda f: save_pickle(f / "a.pkl", {"smpl_poses": np.ndarray}),
        ("file-damaged",)),
    "a type that is called": (
        lambda f: _bytes(f / "a.pkl", b"c__builtin__\nobject\n(tR."), ("file-damaged",)),
    "an array of negative length": (
        lambda f: _bytes(f / "a.pkl", _state((-1,), b"")),
        ("file-damaged",)),
    "objects without an array": (
        lambda f: _bytes(f / "a.pkl", _state((3,), [1])),
        ("file-damaged",)),
    "an array of dates": (
        lambda f: save_pickle(f / "a.pkl", {"a": np.zeros(3, "M8[s]")}),
        ("file-damaged",)),
}  # fmt: skip


def _tree(**more: Any) -> dict[str, Any]:
    data = poselib()
    return {**data, "skeleton_tree": {**data["skeleton_tree"], **more}}


def _bytes(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


class _Array:
    """Pickled as NumPy pickles an array, with another state."""

    def __init__(self, *state: Any) -> None:
        self.state = state

    def __reduce__(self) -> Any:
        made = np.zeros(1).__reduce__()
        return made[0], made[1], (1, self.state[0], np.dtype("O" if self.state[1] else "f8"), False,
                                  self.state[1])  # fmt: skip


def _state(shape: tuple[int, ...], data: Any) -> bytes:
    return pickle.dumps({"smpl_poses": _Array(shape, data)}, 2)


@pytest.mark.parametrize("case", CASES)
def test_a_mistake_is_named(tmp_path: Path, case: str) -> None:
    make, said = CASES[case]
    refusal(make(tmp_path), *said)


def test_a_list_of_one_dict_and_joints_of_the_file_are_taken(tmp_path: Path) -> None:
    plain = read_clip(save_pickle(tmp_path / "a.pkl", aist()), allow_pickle=True)
    again = read_clip(save_pickle(tmp_path / "b.pkl", [aist()]), allow_pickle=True)
    assert np.array_equal(plain.rot, again.rot)
    # Places of another count are no rest pose of this body.
    odd = read_clip(save_npz(tmp_path / "c.npz", {**amass(66), "J": np.zeros((5, 3))}))
    assert np.array_equal(
        odd.skeleton.offsets, read_clip(save_npz(tmp_path / "d.npz", amass(66))).skeleton.offsets
    )


def test_a_rate_of_the_user_and_several_motions(tmp_path: Path) -> None:
    path = save_npz(tmp_path / "a.npz", keys())
    assert read_clip(path, fps=60.0).fps == 60.0
    path = save_npy(tmp_path / "m.npy", mdm(text=["", "a person hops"]))
    with refused("unknown-take", says="2"):
        read_clip(path, allow_pickle=True, take="2")


def test_limits_of_archives_and_pickles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save_npz(tmp_path / "a.npz", keys())
    monkeypatch.setattr(array_files, "MAX_KEYS", 2)
    refusal(path, "over-limit", "2")
    monkeypatch.setattr(array_files, "MAX_KEYS", 4096)
    most = directory_bytes(path)
    assert 0 < most < path.stat().st_size
    monkeypatch.setattr(array_files, "MAX_DIRECTORY", most - 1)
    with monkeypatch.context() as unread:
        unread.delattr(array_files.zipfile, "ZipFile")
        refusal(path, "over-limit", "4096")
    monkeypatch.setattr(pickles, "_MAX_STEPS", 5)
    path = save_pickle(tmp_path / "a.pkl", aist())
    refusal(path, "over-limit", "5")


def test_records_of_poises_own_files(tmp_path: Path) -> None:
    write_clip(odd_clip(), tmp_path / "a.poise.npz")
    with np.load(tmp_path / "a.poise.npz") as file:
        sound = dict(file)
    for change, said in (
        ({"source": np.array("[1]")}, ("file-damaged",)),
        ({"source": np.array("{" + " " * 2_000_000)}, ("file-damaged",)),
        ({"offsets": sound["offsets"] * 1e12}, ("number-unusable", "offsets")),
    ):
        refusal(save_npz(tmp_path / "b.poise.npz", {**sound, **change}), *said)


def test_c3d_files_of_several_people_and_unknown_units(tmp_path: Path) -> None:
    both = np.concatenate((walking(), walking() + 1), 1) * 1000
    labels = (*(f"Anna:{n}" for n in NAMES), *(f"Ben:{n}" for n in NAMES))
    write_c3d(tmp_path / "a.c3d", both, labels, unit="yards")
    raw = c3d.c3d_points(tmp_path / "a.c3d")
    assert raw.names == labels[: len(NAMES)] and raw.unit_m is None
    assert np.allclose(raw.positions, both[:, : len(NAMES)], atol=1e-3)
    assert "holds 2 people: 'Anna' was read; the other is 'Ben'" in raw.notes[0]
    assert raw.notes[1] == "The unit 'yards' is not known"


def test_c3d_files_that_cannot_be_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.c3d"
    write_c3d(path, walking() * 1000, NAMES)
    whole = path.read_bytes()
    path.write_bytes(whole[:16] + b"\xff\x00" + whole[18:])
    refusal(path, "file-cut-off")
    path.write_bytes(whole)
    point: dict[str, Any] = {"points": np.ones((4, 3, 8)), "residuals": np.zeros((1, 3, 8)),
                             "rate": np.zeros(1), "LABELS": np.array(["a", "b", "c"])}  # fmt: skip
    monkeypatch.setattr(c3d, "read_limited", lambda *_: dict(point))
    refusal(path, "rate-out-of-range", "0")
    point["LABELS"] = np.array(["a", "b", "c", "d"])
    refusal(path, "count-differs", ("3", "4"))
    monkeypatch.setattr(c3d, "find_spec", lambda _: None)
    refusal(path, "extra-missing")


@pytest.mark.parametrize("comment", [b"", b"a comment", b"x" * 65_535])
def test_the_size_of_a_directory_is_read_where_python_reads_it(tmp_path: Path, comment: bytes) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for k in range(5):
            archive.writestr(f"{k}.npy", b"0" * 100)
        archive.comment = comment
    with path.open("rb") as file:
        assert directory_bytes(path) == 5 * (46 + 5)
        file.seek(0)
        assert len(zipfile.ZipFile(file).infolist()) == 5


def test_the_size_of_a_directory_of_64_bits(tmp_path: Path) -> None:
    path, entries = tmp_path / "a.npz", 1 << 40
    wide = struct.pack("<4sQ2H2L4Q", b"PK\x06\x06", 44, 45, 45, 0, 0, 1, 1, entries, 0)
    points = struct.pack("<4sLQL", b"PK\x06\x07", 0, 0, 1)
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 0xFFFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0)
    path.write_bytes(b"PK\x03\x04" + wide + points + end)
    # No more than the file has.
    assert directory_bytes(path) == path.stat().st_size
    path.write_bytes(b"PK\x03\x04" + b"nothing")
    assert directory_bytes(path) == 0
