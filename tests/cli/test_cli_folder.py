"""A folder as input: every file on its own, a table, and an exit code that says the worst."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tiny_clips import deepmimic, put

from poise.cli.console import INTERRUPTED, LOST, Answer
from poise.cli.main import main
from poise.cli.options import each
from poise.formats import read_clip, write_clip
from poise.formats.refused import LOOKED_AT, refuse_flat_folder
from poise.jobs.library.files import motion_files_of
from poise.jobs.library.folder import library_of
from poise.motion import trim
from toy_policy import WALK, toy_run

#: The walk's joints in the order of SMPL's.
SMPL = (
    *("Hips", "LeftUpLeg", "RightUpLeg", "Spine", "LeftLeg", "RightLeg", "Spine1", "LeftFoot"),
    *("RightFoot", "Spine2", "LeftToe", "RightToe", "Neck", "LeftShoulder", "RightShoulder", "Head"),
    *("LeftArm", "RightArm", "LeftForeArm", "RightForeArm", "LeftHand", "RightHand"),
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two motions, one of them in a folder below, and a BVH file that is none."""
    root = tmp_path / "clips"
    (root / "deep").mkdir(parents=True)
    write_clip(trim(read_clip(WALK), 0, 30), root / "walk.bvh")
    put(root / "deep", "stand.txt", deepmimic())
    put(root, "notes.md", "no motion")
    put(root, "broken.bvh", "HIERARCHY\n")
    return root


def smpl_joints() -> np.ndarray:
    """`(30, 22, 3)` the places of SMPL's joints in a walk."""
    clip = trim(read_clip(WALK), 0, 30)
    at = [clip.skeleton.names.index(name) for name in SMPL]
    return clip.positions()[:, at]


def states(found: dict) -> dict[str, int]:
    return {Path(f["inputs"][0]).stem: f["exit_code"] for f in found["result"]["files"]}


def test_info_convert_and_doctor(folder: Path, tmp_path: Path, answered, capsys) -> None:
    for argv in (("info", folder), ("doctor", folder)):
        found = answered(*argv, code=2)
        assert states(found) == {"walk": 0, "stand": 0, "broken": 2} and found["inputs"] == [str(folder)]
    out = tmp_path / "out"
    found = answered("convert", folder, "-o", out, "--to", "glb", code=2)
    assert states(found) == {"walk": 0, "stand": 0, "broken": 2}
    assert {p.name for p in out.iterdir()} == {"walk.glb", "deep-stand.glb"}
    assert main(["convert", str(folder), str(tmp_path / "two"), "--to", "fbx"]) == 2
    (folder / "broken.bvh").unlink()
    assert main(["doctor", str(folder), "--fix", "-o", str(tmp_path / "mended")]) == 0
    capsys.readouterr()
    assert main(["convert", str(folder), str(out), "--to", "glb"]) == 2
    said = capsys.readouterr()
    assert "refused" in said.out and "--force" in said.out and "2 of 2  walk" in said.err


def test_arrays_are_read_like_other_files(tmp_path: Path, answered) -> None:
    for name, array in {
        "x": smpl_joints(), "features": np.zeros((20, 263)), "Mean": np.zeros(263), "n": np.array(3),
    }.items():  # fmt: skip
        np.save(tmp_path / f"{name}.npy", array)
    assert states(answered("info", tmp_path, code=2)) == {"x": 0, "features": 2}
    assert [f.path.stem for f in motion_files_of(tmp_path)] == ["features", "x"]
    library, report = library_of(tmp_path, fps=20.0)
    assert len(library.clips) == 1 and "features of HumanML3D" in " ".join(report.sentences())


def test_track_says_which_were_lost(folder: Path, tmp_path: Path, answered, capsys) -> None:
    policy, out = toy_run(tmp_path / "run"), tmp_path / "out"
    argv = ["track", str(folder), "--policy", str(policy), "-o", str(out), "--controller", "policy"]
    found = answered(*argv, code=2)
    assert states(found) == {"walk": LOST, "stand": 0, "broken": 2}
    assert (out / "walk/score.json").exists() and (out / "deep-stand/report.html").exists()
    assert not (out / "broken").exists()
    (folder / "broken.bvh").unlink()
    (folder / "deep/stand.txt").unlink()
    capsys.readouterr()
    assert main([*argv, "--force"]) == LOST
    said = capsys.readouterr().out
    assert "error mm" in said and "lost" in said and "walk" in said


def test_ctrl_c_ends_the_folder(folder: Path) -> None:
    def stopped(path: Path, name: str) -> Answer:
        if name == "deep-stand":
            raise KeyboardInterrupt
        return Answer(outcome="done")

    answer = each("info", (folder,), None, stopped)
    assert answer.exit_code == INTERRUPTED and len(answer.result["files"]) == 1


def test_what_takes_single_files_says_so(folder: Path, tmp_path: Path, refused) -> None:
    (tmp_path / "empty").mkdir()
    refused("imitate", folder, "-o", tmp_path / "out", words=("folder", "poise fleet"))
    refused("info", tmp_path / "empty", words=("no motion file", "TRC", "docs/formats.md"))


def test_a_large_folder_is_not_listed_to_refuse_it(tmp_path: Path, monkeypatch) -> None:
    listed: list[int] = []

    def endless(folder: Path, pattern: str) -> Iterator[Path]:
        for k in range(10 * LOOKED_AT):
            listed.append(k)
            yield folder / f"{k}.txt"

    monkeypatch.setattr(Path, "rglob", endless)
    refuse_flat_folder(tmp_path)
    assert len(listed) == LOOKED_AT


def test_2d_keypoints_are_named(tmp_path: Path, refused) -> None:
    frame = '{"version": 1.3, "people": [{"pose_keypoints_2d": [1, 2, 0.9]}]}'
    (tmp_path / "json" / "cam1").mkdir(parents=True)
    put(tmp_path / "json" / "cam1", "a_000000000000_keypoints.json", frame)
    for verb in (("info",), ("fleet", "-o", tmp_path / "out")):
        told = ("2D keypoints of one camera (OpenPose)", "no depth", "3D poses")
        refused(verb[0], tmp_path / "json", *verb[1:], words=told)
