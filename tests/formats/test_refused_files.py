"""What is wrong with a file before its content counts, and where a clip goes back to."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from handmade_motion_files import bvh_text, deepmimic_text, put
from handmade_numpy_files import amass, odd_clip, save_npz

from poise.errors import PoiseError
from poise.formats import apart, read_clip, text, write_clip
from poise.formats import table as formats
from poise.formats.bvh import write_bvh
from poise.formats.table import check_writable, home_suffix
from refusals import refused


def refusal(path: Path, *told: Any, **options: Any) -> str:
    with refused(*told) if told else pytest.raises(PoiseError) as error:
        read_clip(path, **options)
    message = str(error.value)
    assert message.startswith(str(path)) and message.isprintable()
    return message.removeprefix(str(path))


def test_paths_that_are_no_files(tmp_path: Path) -> None:
    refusal(tmp_path / ("x" * 300 + ".bvh"), "file-unreadable")
    loop = tmp_path / "loop.bvh"
    loop.symlink_to(loop)
    refusal(loop, "file-unreadable")
    (tmp_path / "notes.json").write_text("[1]")
    refusal(tmp_path, "is-folder")
    with refused("is-folder"):
        text.check_file(tmp_path)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may read anything")
def test_files_that_may_not_be_read(tmp_path: Path) -> None:
    path = put(tmp_path, "a.bvh", bvh_text())
    path.chmod(0)
    assert refusal(path) == ": the file cannot be read (Permission denied)"


def test_files_that_fail_while_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = put(tmp_path, "a.bvh", bvh_text())

    def broken(*_: Any, **__: Any) -> Any:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(Path, "open", broken)
    monkeypatch.setattr(Path, "read_bytes", broken)
    for read in (text.read_head, text.read_bytes, text.read_binary):
        with pytest.raises(PoiseError) as error:
            read(path)
        assert str(error.value) == f"{path}: the file cannot be read (Input/output error)"


def test_a_file_that_grows_beyond_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = put(tmp_path, "a.bvh", bvh_text())
    # It was small when its size was asked for.
    monkeypatch.setattr(text, "check_file", lambda *_: 10)
    with refused("file-too-big"):
        text.read_bytes(path, limit=100)


def test_a_machine_without_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> Any:
        raise MemoryError

    reader = formats.Reader("BVH", (".bvh",), lambda head: True, full)
    monkeypatch.setattr(formats, "READERS", (reader,))
    said = refusal(put(tmp_path, "a.bvh", bvh_text()))
    assert said == ": the file needs more memory than there is. Cut it shorter"


def test_a_clip_goes_back_to_the_format_it_came_from(tmp_path: Path) -> None:
    write_clip(odd_clip(), tmp_path / "a.glb")
    came = {
        ".bvh": put(tmp_path, "a.bvh", bvh_text()), ".glb": tmp_path / "a.glb",
        ".npz": save_npz(tmp_path / "a.npz", amass(66)),
    }  # fmt: skip
    assert {suffix: home_suffix(read_clip(path)) for suffix, path in came.items()} == {
        k: k for k in came
    }
    assert home_suffix(read_clip(put(tmp_path, "a.txt", deepmimic_text()))) == ".bvh"
    check_writable(tmp_path / "b.bvh")
    with refused("format-not-written", says=".c3d"):
        check_writable(tmp_path / "b.c3d")
    if find_spec("pxr") is None:
        with refused("extra-missing", says="usd-core"):
            check_writable(tmp_path / "b.usda")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"unit_m": 0.0}, ("out-of-range", "0.0")),
        ({"unit_m": float("inf")}, ("out-of-range", "inf")),
        ({"up_axis": "W"}, ("unknown-axis", "W")),
    ],
)
def test_units_and_verticals_of_a_bvh(tmp_path: Path, options: dict[str, Any], said: tuple) -> None:
    with refused(*said):
        write_bvh(odd_clip(), tmp_path / "b.bvh", **options)
    assert not (tmp_path / "b.bvh").exists()


def test_a_bvh_in_another_unit_and_vertical_is_the_same_motion(tmp_path: Path) -> None:
    clip = read_clip(put(tmp_path, "a.bvh", bvh_text()), unit_m=0.01)
    write_bvh(clip, tmp_path / "b.bvh", unit_m=0.0254, up_axis="Z")
    again = read_clip(tmp_path / "b.bvh", unit_m=0.0254, up_axis="Z")
    assert np.abs(again.positions() - clip.positions()).max() < 1e-5


def test_limits_that_a_platform_lacks_or_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process apart is limited as far as it can be."""
    resource = pytest.importorskip("resource")
    asked = []

    def refuse(kind: int, _: tuple[int, int]) -> None:
        asked.append(kind)
        raise ValueError("not allowed to raise maximum limit")

    monkeypatch.setattr(resource, "setrlimit", refuse)
    monkeypatch.delattr(resource, "RLIMIT_DATA")
    apart.limit(20.0, 1 << 30)
    assert asked == [resource.RLIMIT_CPU, resource.RLIMIT_AS]
