"""Stick figures as an SVG: well-formed, keyframes told apart, nothing outside the picture."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from poise.score.report import PoseRow, pose_rows
from poise.score.report.svg import _busiest
from refusals import refused
from toy_human import swing


def test_a_row_of_figures_with_keyframes_and_ghosts(tmp_path: Path) -> None:
    clip = swing(2.0, speed=1.0)
    pos, frames = clip.positions(), list(range(0, 60, 5))
    row = PoseRow("made <here>", pos, pos + 0.05)
    text = pose_rows("a & b", [row, PoseRow("alone", pos)], clip.skeleton.parents, frames, 30.0, [0, 30],
                     path=tmp_path / "poses.svg")  # fmt: skip
    assert (tmp_path / "poses.svg").read_text() == text
    root = ET.fromstring(text)
    _, _, width, height = (float(x) for x in root.attrib["viewBox"].split())
    paths = [e for e in root.iter() if e.tag.endswith("path")]
    kinds = [e.attrib.get("class") for e in paths]
    assert kinds.count("key") == 4 and kinds.count("ghost") == len(frames)
    assert len([e for e in paths if e.attrib.get("style")]) == 2 * (len(frames) - 2)
    for e in paths:
        numbers = [float(x) for x in re.findall(r"-?[\d.]+", e.attrib["d"])]
        assert all(-1 <= x <= width + 1 for x in numbers[::2]) or "H" in e.attrib["d"]
    # A standing figure is as high as a row.
    ys = [
        float(y)
        for e in paths
        if e.attrib.get("style")
        for y in re.findall(r" (-?[\d.]+)", e.attrib["d"])
    ]
    assert min(ys) > 0 and max(ys) < height


def test_poses_that_do_not_fit_are_refused() -> None:
    pos = swing(1.0).positions()
    with refused("count-differs", says=("19", "40")):
        pose_rows("t", [PoseRow("short", pos)], swing(1.0).skeleton.parents, [0, 40], 30.0)
    with refused("count-differs"):
        pose_rows("t", [PoseRow("other", pos[:, :5])], swing(1.0).skeleton.parents, [0, 1], 30.0)
    assert np.isfinite(pos).all()


def test_a_walk_is_seen_from_beside_and_goes_to_the_right() -> None:
    # Its arms swing a little across, so that the line is not quite that of the path.
    pos = swing(2.0, speed=1.0).positions()
    assert abs(_busiest(pos)) < 0.3
    back = pos * [-1.0, -1.0, 1.0]
    assert abs(abs(_busiest(back)) - np.pi) < 0.3
