"""Disks that are full or read-only, files that are cut: nothing half-written, nothing lost."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, NoReturn

import pytest

import poise
from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from poise.formats.text import write_whole
from poise.jobs.open import open_run
from poise.jobs.result import Result
from poise.jobs.runs import train
from poise.learn import Until
from poise.motion import Clip, trim
from poise.synthesis.keyframes import FilledClips
from refusals import refused

OLD = Path(__file__).resolve().parents[1] / "fixtures/old"
WALK = Path(poise.__file__).parent / "data/walk.bvh"
#: In a process of its own, since its files may have 1,000 bytes each from here on.
FULL = """
import resource, signal, sys
from pathlib import Path
import torch
from poise.cli.main import main
from poise.errors import PoiseError
from poise.learn import load_checkpoint, save_checkpoint
from poise.formats import read_clip, write_clip
walk, folder = Path(sys.argv[1]), Path(sys.argv[2])
clip = read_clip(walk)
names = ["a.bvh", "a.npz", "a.csv", "a.glb", "a.gltf"]
for name in names:
    (folder / name).write_text("old")
save_checkpoint(folder / "c.safetensors", {"x": torch.arange(3.0)}, {"kind": "old"})
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
most = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, most))
said = []
for name in names:
    try:
        write_clip(clip, folder / name)
    except PoiseError as error:
        said.append(str(error))
try:
    save_checkpoint(folder / "c.safetensors", {"x": torch.zeros(9999)}, {"kind": "new"})
except PoiseError as error:
    said.append(str(error))
code = main(["convert", str(walk), str(folder / "new.bvh")])
resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
tensors, meta = load_checkpoint(folder / "c.safetensors")
assert len(said) == 6 and all("written (File too large)" in s for s in said), said
assert code == 2, code
assert meta["kind"] == "old" and tensors["x"].tolist() == [0.0, 1.0, 2.0]
assert all((folder / name).read_text() == "old" for name in names)
assert sorted(p.name for p in folder.iterdir()) == sorted([*names, "c.safetensors"])
"""


@pytest.fixture(scope="module")
def clip() -> Clip:
    return trim(read_clip(WALK), 0, 10)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of files are those of Linux")
def test_a_full_disk_leaves_what_was_there(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-B", "-c", FULL, str(WALK), str(tmp_path)],
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert "File too large" in done.stderr + done.stdout


def test_a_read_only_folder(tmp_path: Path, clip: Clip) -> None:
    folder = tmp_path / "shut"
    folder.mkdir(mode=0o500)
    if os.access(folder, os.W_OK):
        pytest.skip("this user may write anywhere")
    with refused("cannot-write") as error:
        write_clip(clip, folder / "a.bvh")
    assert str(error.value).startswith(str(folder / "a.bvh"))
    assert not list(folder.iterdir())


def test_a_read_only_disk_is_told_with_the_name_that_was_given(
    tmp_path: Path, clip: Clip, monkeypatch: pytest.MonkeyPatch
) -> None:
    def shut(self: Path, *args: Any, **kwargs: Any) -> NoReturn:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self))

    monkeypatch.setattr(Path, "open", shut)
    with pytest.raises(PoiseError) as error:
        write_clip(clip, tmp_path / "a.bvh")
    assert str(error.value).startswith(f"{tmp_path / 'a.bvh'}: the file cannot be written")
    assert ".tmp" not in str(error.value) and not list(tmp_path.iterdir())


def test_a_file_that_cannot_take_its_place_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.txt").write_text("old")

    def shut(self: Path, target: Path) -> NoReturn:
        raise OSError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(Path, "replace", shut)
    with refused("cannot-write"):
        write_whole(tmp_path / "a.txt", "new")
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("a.txt", "old")]


@pytest.mark.parametrize("name", ["run.safetensors", "checkpoint.safetensors"])
def test_run_files_that_are_cut_are_refused_and_left_as_they_are(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "run"
    shutil.copytree(OLD / "imitate", folder)
    whole = (folder / name).read_bytes()
    for keep in (0, 7, 100, len(whole) // 2, len(whole) - 1):
        (folder / name).write_bytes(whole[:keep])
        before = {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}
        with refused("file-damaged", says=name) as error:
            train(open_run(folder).task, folder, Until(iterations=9), threads=1, tensorboard=False)
        assert "\n" not in str(error.value)
        assert {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()} == before


class _Broken:
    """Clips that cannot be made."""

    @property
    def clips(self) -> tuple[Clip, ...]:
        raise PoiseError("nothing to write", code="internal-fault")


def _made(fails: bool = False) -> Result:
    """A result that writes one file, or fails."""
    clip = trim(read_clip(WALK), 0, 3)
    filled: Any = _Broken() if fails else FilledClips((clip,), ())
    return Result(filled=filled, came=clip)


def test_results_are_refused_where_no_folder_can_be(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "keep.txt").write_text("kept")
    (tmp_path / "keep").write_text("kept")
    for name in ("keep.txt/x", "keep.txt/x/y", "keep"):
        with refused("not-a-folder", says="keep"):
            _made().save(tmp_path / name)
    for name in ("keep.txt/x.bvh", "keep.txt/x.glb", "a\0b", "n" * 300):
        with refused("cannot-write"):
            _made().save(tmp_path / name)
    with refused("internal-fault"):
        _made(fails=True).save(tmp_path / "new/deep")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["keep", "keep.txt"]
    for name in ("new/deep", "run_v1.0"):
        assert set(_made().save(tmp_path / name)) == {"filled"}

    def denied(*given: Any, **named: Any) -> NoReturn:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", denied)
    with refused("cannot-write", says=("other", "permission denied")):
        _made().save(tmp_path / "other")
    monkeypatch.setattr(Path, "exists", denied)
    with refused("cannot-write", says=("other.bvh", "permission denied")):
        _made().save(tmp_path / "other.bvh")
