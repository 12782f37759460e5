"""Every real clip of the index reads with the joints, frames and rate that it lists."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from poise.formats import read_clip
from poise.motion import Clip, describe

INCH = 0.0254
ASF_UNIT = 0.0254 / 0.45


def expected_unit(path: str) -> float:
    if path.startswith("deepmimic"):
        return 1.0
    if path.startswith("cmu_amc") or "fairmotion" in path or "14_14" in path or "jumping" in path:
        return ASF_UNIT
    return INCH if "cmu_bvh/ad/" in path else 0.01


def check(clip: Clip, row: dict[str, str]) -> None:
    path = row["path"]
    facts = describe(clip)
    # Both conversions put a rest pose first; acRNN's eases out of it for three to five frames more.
    dropped = sum(int(m[4]) for m in clip.skeleton.source.mended if m[0] == "rest frame")
    assert facts["joints"] == int(row["joints"]), path
    assert facts["frames"] == int(row["frames"]) - dropped, path
    assert abs(facts["fps"] - float(row["fps"])) < 2e-3, path
    assert (dropped in (4, 5, 6)) if "acrnn" in path else dropped == ("fairmotion/" in path), path
    assert np.isclose(facts["unit_m"], expected_unit(path)), path
    z_up = "cmu_bvh/ad/" in path and "14_14" not in path and "jumping" not in path
    assert facts["up_axis"] == ("Z" if z_up else "Y"), path
    assert 1.35 < facts["height_m"] < 1.9, path
    # No body is far below the floor or flies above it.
    assert -0.35 < clip.positions()[..., 2].min() < 0.35, path


def test_all_files_of_the_index(data_dir: Path) -> None:
    with (data_dir / "INDEX.tsv").open(newline="") as file:
        rows = [r for r in csv.DictReader(file, delimiter="\t")]
    wanted = [r for r in rows if r["format"] in ("bvh", "asf/amc", "deepmimic-json")]
    wanted = [r for r in wanted if "malformed" not in r["path"]]
    assert len(wanted) > 150
    for row in wanted:
        skeleton = data_dir / "cmu_amc/rfc/08.asf" if "/rfc/" in row["path"] else None
        check(read_clip(data_dir / row["path"], skeleton=skeleton), row)


def test_arrays_of_the_index(data_dir: Path) -> None:
    with (data_dir / "INDEX.tsv").open(newline="") as file:
        rows = {r["path"]: r for r in csv.DictReader(file, delimiter="\t")}
    kinds = {
        "smpl-pkl(72d)": "smpl",
        "poselib-npy": "poselib",
        "npz": "opensim",
        "opensim-mot": "opensim",
    }
    wanted = [r for r in rows.values() if r["format"] in kinds]
    assert len(wanted) == 9
    for row in wanted:
        clip = read_clip(data_dir / row["path"], allow_pickle=True)
        facts = describe(clip)
        assert facts["format"] == kinds[row["format"]], row["path"]
        assert facts["frames"] == int(row["frames"]), row["path"]
        # Of OpenSim's coordinates only those that turn a person's joints are counted.
        assert facts["joints"] == (17 if facts["format"] == "opensim" else int(row["joints"]))
        if row["fps"]:
            assert abs(facts["fps"] - float(row["fps"])) < 2e-3, row["path"]
        smpl = facts["format"] == "smpl"
        assert np.isclose(facts["unit_m"], 1 / 93.77886 if smpl else 1.0), row["path"]
        assert facts["up_axis"] == ("Z" if facts["format"] == "poselib" else "Y"), row["path"]
        assert 1.4 < facts["height_m"] < 1.8, row["path"]


def test_known_teleports(data_dir: Path) -> None:
    for name, frames in (("04", ("341", "342", "345")), ("10", ("313", "352", "357"))):
        clip = read_clip(data_dir / f"cmu_bvh/acrnn_salsa/{name}.bvh")
        note = next(n for n in clip.skeleton.source.notes if n.startswith("The root jumps"))
        assert all(f in note for f in frames)
