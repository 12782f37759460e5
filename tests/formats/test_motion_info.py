"""Guesses of unit, vertical and height, their overrides, and the facts told about a clip."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from handmade_motion_files import BVH_HEADER, bvh_rows, bvh_text, deepmimic_text, put

from poise.formats import read_clip, write_bvh
from poise.motion import describe
from refusals import refused


def scaled(factor: float) -> str:
    """The person in centimetres with all lengths scaled."""
    lines = []
    for line in BVH_HEADER.splitlines():
        words = line.split()
        if words[:1] == ["OFFSET"]:
            line = "OFFSET " + " ".join(str(float(w) * factor) for w in words[1:])
        lines.append(line)
    rows = []
    for row in bvh_rows():
        v = [float(w) for w in row.split()]
        rows.append(" ".join(map(str, [x * factor for x in v[:3]] + v[3:])))
    return bvh_text(rows, header="\n".join(lines) + "\n")


@pytest.mark.parametrize("unit", [1.0, 0.01, 0.001, 0.0254, 0.0254 / 0.45])
def test_unit_is_guessed_from_the_height(tmp_path: Path, unit: float) -> None:
    clip = read_clip(put(tmp_path, "a.bvh", scaled(0.01 / unit)))
    assert clip.skeleton.source.unit_m == pytest.approx(unit)
    assert describe(clip)["height_m"] == pytest.approx(1.60 / 0.92, rel=1e-6)


def test_unit_override(tmp_path: Path) -> None:
    path = put(tmp_path, "a.bvh", bvh_text())
    clip = read_clip(path, unit_m=0.02)
    assert clip.root_pos[0, 2] == pytest.approx(1.8)
    for unit in (0.0, -1.0, float("nan")):
        with refused("out-of-range", says="--unit"):
            read_clip(path, unit_m=unit)
    with refused("unknown-axis", says="W"):
        read_clip(path, up_axis="W")
    for fps in (0, -1.0, float("nan"), 1e6, 1e300):
        with refused("rate-out-of-range", says="--fps"):
            read_clip(path, fps=fps)


def test_up_override_and_fps_override(tmp_path: Path) -> None:
    clip = read_clip(put(tmp_path, "a.bvh", bvh_text()), up_axis="z", fps=25)
    np.testing.assert_allclose(clip.root_pos[0], [0, 0.9, 0])
    assert clip.fps == 25 and clip.skeleton.source.up_axis == "Z"


def test_lying_people_keep_their_vertical(data_dir: Path, tmp_path: Path) -> None:
    for name in ("getup_faceup", "crawl", "roll"):
        clip = read_clip(data_dir / f"deepmimic_txt/humanoid3d_{name}.txt")
        # A quarter turn about the vertical lays the body along the other horizontal axis.
        for quarter in (0, 1):
            turned = _turned(clip, quarter)
            for up in ("Y", "Z"):
                write_bvh(turned, tmp_path / "a.bvh", up_axis=up)
                assert read_clip(tmp_path / "a.bvh").skeleton.source.up_axis == up, (name, quarter, up)


def _turned(clip, quarter: int):  # type: ignore[no-untyped-def]

    from poise.motion.rotations import quat_mul, quat_rotate

    half = np.pi / 4 * quarter
    q = np.array([np.cos(half), 0, 0, np.sin(half)], dtype=float)
    pos, rot = clip.arrays()
    rot[:, 0] = quat_mul(np.broadcast_to(q, (len(rot), 4)), rot[:, 0])
    return clip.replaced(root_pos=quat_rotate(np.broadcast_to(q, (len(pos), 4)), pos), rot=rot)


def test_describe(tmp_path: Path) -> None:
    facts = describe(read_clip(put(tmp_path, "a.txt", deepmimic_text())))
    assert list(facts) == [
        "format", "joints", "fps", "frames", "seconds", "unit_m", "up_axis", "height_m",
        "height_from", "warnings",
    ]  # fmt: skip
    assert facts["format"] == "deepmimic" and facts["joints"] == 15 and facts["warnings"] == []
    assert facts["seconds"] == pytest.approx(0.1)
    assert facts["height_from"] == "from the bones between neck and ankles"
    assert 1.6 < facts["height_m"] < 1.8


def test_guesses_are_told(tmp_path: Path) -> None:
    assert describe(read_clip(put(tmp_path, "a.bvh", bvh_text())))["warnings"] == [
        "The file states no vertical: Y taken, since the body stands along it",
        "The file states no unit: centimetres taken, which make the person 1.74 m tall "
        "(from the bones between head and ankles)",
    ]
