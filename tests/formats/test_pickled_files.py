"""Pickles are read without pickle: plain data come out equal, anything else is refused unread."""

from __future__ import annotations

import collections
import os
import pickle
import pickletools
import random
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from handmade_numpy_files import aist, poselib, save_npy, save_npz, save_pickle

from poise.errors import PoiseError
from poise.formats import pickles, read_clip, write_clip
from poise.formats.pickles import load_plain, loads_restricted, named_arrays
from refusals import refused


def load_restricted(path):  # type: ignore[no-untyped-def]
    return named_arrays(load_plain(path), Path(path))


def same(a: Any, b: Any) -> bool:
    if isinstance(b, dict):
        return isinstance(a, dict) and a.keys() == b.keys() and all(same(a[k], b[k]) for k in b)
    if isinstance(b, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(b, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and np.array_equal(a, b)
    return bool(a == b)


PLAIN = {
    "array": np.arange(6.0).reshape(2, 3),
    "turned": np.arange(6, dtype=np.int16).reshape(2, 3).T,
    "big-endian": np.ones((3, 2), dtype=">i4"),
    "truth": np.array([True, False]),
    "text": np.array(["a", "böc"]),
    "empty": np.zeros((0, 3), dtype=np.float32),
    "number": np.float32(2.5),
    "list": [1, -2.5, "ö", None, True, False, (1,), (1, 2), (1, 2, 3), (1, 2, 3, 4), ()],
    "bytes": b"\0\xff",
    "long": 2**70,
    "dict": collections.OrderedDict(a=1, b={"c": []}),
}


@pytest.mark.parametrize("protocol", range(6))
def test_plain_data_come_out_equal(tmp_path: Path, protocol: int) -> None:
    path = save_pickle(tmp_path / "a.pkl", PLAIN, protocol)
    assert same(load_restricted(path), PLAIN)
    shared = [1, 2]
    data = pickle.dumps([shared, shared, np.array([shared, None, "x"], dtype=object)], protocol)
    assert loads_restricted(data, "a") == [[1, 2], [1, 2], [[1, 2], None, "x"]]


def test_the_real_files_agree_with_pickle(data_dir: Path) -> None:
    paths = [*(data_dir / "other/ase_npy").glob("*.npy"), *(data_dir / "amass").glob("*.pkl")]
    paths.append(data_dir / "other/text_to_motion/mdm_results_pred.npy")
    for path in paths:
        if path.suffix == ".npy":
            wanted = np.load(path, allow_pickle=True).item()
        else:
            wanted = pickle.loads(path.read_bytes())
        assert same(load_restricted(path), wanted), path


class Evil:
    def __reduce__(self) -> tuple[Any, ...]:
        return (os.system, ("touch evil",))


def hashed_for_ever() -> bytes:
    """A dict with a key that is a tuple of tuples of tuples: its hash takes 2^60 steps."""
    step = b"q\x01h\x01h\x01\x86"
    return b"\x80\x02}(" + b"K\x01" + step * 60 + b"K\x01u."


REFUSED = {
    "a call": (pickle.dumps({"a": Evil()}), ("pickle-refused", "posix.system")),
    "a class": (pickle.dumps(Path("a")), ("pickle-refused",)),
    "numpy's load": (b"\x80\x02cnumpy\nload\n.", ("pickle-refused", "numpy.load")),
    "builtins": (b"\x80\x02c__builtin__\neval\n.", ("pickle-refused", "__builtin__.eval")),
    "an instance": (b"\x80\x02(i__main__\nA\n.", ("pickle-refused", "INST")),
    "persistent": (b"\x80\x02Pabc\n.", ("pickle-refused", "PERSID")),
    "an extension": (b"\x80\x02\x82\x01.", ("pickle-refused", "EXT1")),
    "cut off": (pickle.dumps(PLAIN)[:-200], ("file-damaged",)),
    "no end": (b"\x80\x02K\x01", ("file-damaged",)),
    "empty stack": (b"\x80\x02.", ("file-damaged",)),
    "no mark": (b"\x80\x02]e.", ("file-damaged",)),
    "huge bytes": (b"\x80\x04\x8e" + struct.pack("<Q", 1 << 60) + b"ab.", ("file-damaged",)),
    "huge bytearray": (b"\x80\x05\x96" + struct.pack("<Q", 1 << 40) + b"ab.", ("file-damaged",)),
    "a set": (pickle.dumps({"a": {1}}), ("pickle-refused", "EMPTY_SET")),
    "no instruction": (b"\x80\x02\xff.", ("pickle-refused",)),
    "a state of a list": (b"\x80\x02]}b.", ("file-damaged",)),
    "a call of a list": (b"\x80\x02])R.", ("file-damaged",)),
    "huge array": (
        b"\x80\x02cnumpy\nndarray\n0cnumpy.core.multiarray\n_reconstruct\n)R(K\x01\x8a\x06"
        + (1 << 44).to_bytes(6, "little")
        + b"\x85cnumpy\ndtype\nX\x02\x00\x00\x00f8\x85R\x89U\x01atb.",
        ("pickle-refused", "POP"),
    ),
    "bytes of a number": (
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\n)R(K\x01K\x05\x85cnumpy\ndtype\nX\x02\x00\x00"
        b"\x00f8\x85R\x89J\xff\xff\xff\x7ftb.",
        ("file-damaged",),
    ),
    "hash bomb": (hashed_for_ever(), ("file-damaged",)),
    "nesting": (b"\x80\x02" + b"]" * 5000 + b"a" * 4999 + b".", ("nested-too-deep",)),
    "a list": (pickle.dumps([1, 2]), ("wrong-type", "list")),
    "odd keys": (pickle.dumps({1: 2}), ("wrong-type",)),
    "structured": (
        pickle.dumps({"a": np.zeros(2, dtype=[("x", "f8")])}),
        ("file-damaged",),
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals(tmp_path: Path, case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    data, message = REFUSED[case]
    path = tmp_path / "a.pkl"
    path.write_bytes(data)
    start = time.perf_counter()
    with refused(*message) as error:
        load_restricted(path)
    text = str(error.value)
    assert text.startswith(f"{path}: ") and "\n" not in text
    assert time.perf_counter() - start < 2.0
    assert not (tmp_path / "evil").exists()


def test_a_memo_of_two_billion_slots_takes_no_memory() -> None:
    data = b"\x80\x02K\x07r" + struct.pack("<I", (1 << 31) - 1) + b"."
    assert loads_restricted(data, "a") == 7


def test_bytes_that_are_shared_do_not_multiply(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pickles, "MAX_ARRAY_BYTES", 4000)
    # One buffer of 800 bytes from which many arrays are made by reference.
    one = b"cnumpy.core.multiarray\nscalar\ncnumpy\ndtype\nX\x04\x00\x00\x00S800\x85Rh\x01\x86R"
    start = b"\x80\x03](B" + struct.pack("<I", 800) + bytes(800) + b"q\x01"
    assert len(loads_restricted(start + one * 5 + b"e.", "a")) == 6
    array = (
        b"cnumpy.core.multiarray\n_reconstruct\n)R(K\x01K\x64\x85cnumpy\ndtype\nX\x02\x00\x00\x00f8\x85R"
        b"\x89h\x01tb"
    )
    assert len(loads_restricted(start + array * 9 + b"e.", "a")) == 10
    with refused("over-limit"):
        loads_restricted(start + array * 12 + b"e.", "a")


def test_damaged_pickles_never_break_out() -> None:
    rng = random.Random(0)
    whole = [pickle.dumps(aist(4), p) for p in (2, 4)] + [pickle.dumps(poselib(3), 3)]
    read = 0
    for _ in range(600):
        data = bytearray(rng.choice(whole))
        for _ in range(rng.randint(1, 6)):
            data[rng.randrange(len(data))] = rng.randrange(256)
        try:
            loads_restricted(bytes(data[: rng.randint(20, len(data))]), "a")
            read += 1
        except PoiseError as error:
            assert "\n" not in str(error)
    assert read < 600


def test_no_instruction_is_known_that_calls_or_looks_up() -> None:
    from poise.formats.pickles import _STEPS

    known = {op.name for op in pickletools.opcodes}
    assert set(_STEPS) <= known
    for name in ("INST", "OBJ", "NEWOBJ", "NEWOBJ_EX", "PERSID", "BINPERSID", "EXT1", "EXT2", "EXT4"):
        assert name in known and name not in _STEPS


def test_poselib_local_and_global_are_one_motion(tmp_path: Path) -> None:
    data = poselib()
    with refused("pickle-refused", says="--allow-pickle"):
        read_clip(save_npy(tmp_path / "a.npy", data))
    clip = read_clip(tmp_path / "a.npy", allow_pickle=True)
    assert clip.fps == 30.0 and clip.skeleton.names == tuple(data["skeleton_tree"]["node_names"])
    assert clip.skeleton.source.format == "poselib" and clip.skeleton.source.up_axis == "Z"
    assert any("sword" in n for n in clip.skeleton.source.notes)
    np.testing.assert_allclose(clip.root_pos, data["root_translation"]["arr"])
    # Every joint turns about Y: angles add up along the tree.
    xyzw = data["rotation"]["arr"]
    angle = 2 * np.arctan2(xyzw[..., 1], xyzw[..., 3])
    total = angle.copy()
    for j, parent in ((1, 0), (2, 1), (3, 0), (4, 1)):
        total[:, j] = total[:, parent] + angle[:, j]
    head = clip.positions()[:, 2]
    wanted = clip.root_pos[:, 0] + 0.5 * np.sin(total[:, 0]) + 0.2 * np.sin(total[:, 1])
    np.testing.assert_allclose(head[:, 0], wanted, atol=1e-7)
    turned = poselib(is_local=False)
    turned["rotation"]["arr"] = np.stack(
        (0 * total, np.sin(total / 2), 0 * total, np.cos(total / 2)), -1
    )
    other = read_clip(save_npy(tmp_path / "b.npy", turned), allow_pickle=True)
    np.testing.assert_allclose(other.positions(), clip.positions(), atol=1e-9)
    write_clip(clip, tmp_path / "c.npz")
    np.testing.assert_array_equal(read_clip(tmp_path / "c.npz").rot, clip.rot)


def test_poselib_refusals(tmp_path: Path) -> None:
    def refusal(**changes: Any) -> str:
        data = poselib()
        data.update(changes)
        data = {k: v for k, v in data.items() if v is not None}
        path = save_npy(tmp_path / "a.npy", data)
        with pytest.raises(PoiseError) as error:
            read_clip(path, allow_pickle=True)
        return str(error.value).removeprefix(str(path))

    bad = poselib()["rotation"]["arr"].copy()
    bad[3, 1] *= 2
    assert refusal(rotation={"arr": bad}) == (
        ", frame 3: the quaternion of joint 'torso' has length 2, no rotation"
    )
    bad[3, 1, 0] = np.nan
    assert refusal(rotation={"arr": bad}) == (
        ": the rotation of joint 'torso' at frame 3 is nan, not a usable number"
    )
    assert refusal(root_translation=None).startswith(": this poselib motion lacks root_translation.")
    assert refusal(fps=0) == (
        ": the frame rate must be from 0.1 to 2000 per second, got 0. State the right one with --fps F"
    )
    tree = dict(poselib()["skeleton_tree"])
    tree["parent_indices"] = np.array([-1, 2, 0, 0, 1])
    assert refusal(skeleton_tree=tree) == ": its parent_indices do not put parents before children"
    assert refusal(rotation={"arr": np.zeros((8, 4, 4))}) == (
        ", array 'rotation': it has the shape 8 x 4 x 4, not any x 5 x 4"
    )


def test_real_falls_and_runs(data_dir: Path) -> None:
    for path in sorted((data_dir / "other/ase_npy").glob("*.npy")):
        clip = read_clip(path, allow_pickle=True)
        assert len(clip.skeleton) in (15, 17) and 25 <= clip.frames <= 195
        assert abs(clip.fps - 30) < 0.2
        assert -0.3 < clip.positions()[..., 2].min() < 0.1


def test_a_pickled_member_of_an_npz_is_asked_for(tmp_path: Path) -> None:
    from handmade_numpy_files import amass

    data = {**amass(66), "gender": np.array("male", dtype=object)}
    path = save_npz(tmp_path / "a.npz", data)
    with refused("pickle-refused", says="array 'gender'"):
        read_clip(path)
    clip = read_clip(path, allow_pickle=True)
    assert dict(clip.skeleton.source.extra)["gender"] == "male"
