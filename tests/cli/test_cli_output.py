"""What verbs write: nothing that is there is lost, names with dots, OUT with and without -o."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from tiny_clips import MINIATURE, put

from poise.cli.main import main
from poise.cli.options import places
from poise.jobs.keep import may_write
from refusals import refused


def test_names_with_dots(tmp_path: Path) -> None:
    (tmp_path / "there.xyz").mkdir()
    assert places(Path("run_v1.0")) == (Path("run_v1.0"), None)
    assert places(Path("a.b/result")) == (Path("a.b/result"), None)
    assert places(Path("out.v2.bvh")) == (Path("out.v2"), Path("out.v2.bvh"))
    assert places(Path("out.GLB")) == (Path("out"), Path("out.GLB"))
    assert places(Path("take.2")) == (Path("take.2"), None)
    assert places(Path("take.v2")) == (Path("take.v2"), None)
    assert places(tmp_path / "there.xyz") == (tmp_path / "there.xyz", None)
    for name in ("out.amc", "out.trc", "out.xyz", "out.BVHX", "out.mp4", "out.h5"):
        with refused("format-not-written"):
            places(Path(name))


def test_files_are_written_over_only_with_force(
    clip: Path, trained: Path, tmp_path: Path, refused
) -> None:
    old = put(tmp_path, "old.bvh", "something of the user's")
    words = (str(old), "there already", "--force")
    refused("convert", clip, old, words=words)
    refused("convert", clip, "-o", old, words=words)
    refused("retarget", clip, "--onto", clip, "-o", old, words=words)
    refused("doctor", clip, "--fix", "-o", old, words=words)
    refused("inbetween", clip, "--keyframes", "0,5", "-o", old, words=words)
    refused("track", clip, "-o", old, words=words)
    refused("imitate", clip, "-o", old, words=words)
    refused("play", trained, "-o", old, words=words)
    policy = put(tmp_path, "policy.safetensors", "a policy")
    refused("track", clip, "-o", tmp_path / "out", "--save-policy", policy, words=("--force",))
    assert main(["convert", str(clip), str(old), "--force"]) == 0
    assert old.read_text().startswith("HIERARCHY")


def test_results_of_others_stay(clip: Path, trained: Path, tmp_path: Path, refused) -> None:
    out = tmp_path / "out"
    out.mkdir()
    put(out, "score.json", "{}")
    for verb in ("imitate", "track"):
        refused(verb, clip, "-o", out, words=("score.json", "--force"))
    refused("imitate", clip, "-o", out, "--resume", words=("score.json", "--force"))
    assert main(["imitate", str(clip), "-o", str(out), *MINIATURE, "--force"]) == 0
    # A run of its own is gone on with; --force does not take it away.
    refused("imitate", clip, "-o", out, "--force", words=("already holds a run", "--resume"))
    assert main(["imitate", str(clip), "-o", str(out), *MINIATURE, "--resume"]) == 0
    # Poise's own page is made anew.
    mine = shutil.copytree(trained, tmp_path / "mine")
    assert main(["play", str(mine)]) == 0 and main(["play", str(mine)]) == 0


@pytest.mark.skipif(os.name != "posix", reason="links and pipes")
def test_links_and_pipes_are_not_replaced(clip: Path, tmp_path: Path, refused) -> None:
    target = put(tmp_path, "target.bvh", "kept")
    (link := tmp_path / "link.bvh").symlink_to(target)
    os.mkfifo(pipe := tmp_path / "pipe.bvh")
    for force in ((), ("--force",)):
        refused("convert", clip, link, *force, words=("symbolic link",))
        refused("convert", clip, pipe, *force, words=("pipe",))
    (tmp_path / "folder.bvh").mkdir()
    refused("convert", clip, tmp_path / "folder.bvh", "--force", words=("is a folder",))
    assert link.is_symlink() and target.read_text() == "kept"


def test_nothing_is_written_over_what_is_read(tmp_path: Path) -> None:
    here = put(tmp_path, "a.bvh", "text")
    with refused("would-overwrite-source"):
        may_write(here, True, tmp_path / "absent", here)
    may_write(here, True, tmp_path / "absent")
    may_write(tmp_path / "new.bvh", False, here)
