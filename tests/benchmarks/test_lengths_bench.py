"""What `benchmarks/lengths.py` joins is one motion near the origin; what it runs is timed."""

from __future__ import annotations

import sys
from pathlib import Path

import lengths
import numpy as np
import pytest

import poise
from poise.formats import read_clip


def test_walks_are_joined_into_a_long_one():
    """No frame jumps, and the walk turns back instead of leading away."""
    walk = read_clip(Path(poise.__file__).parent / "data/walk.bvh")
    long = lengths.joined([walk, walk], 1.0, 0)
    steps = np.linalg.norm(np.diff(long.root_pos, axis=0), axis=1)
    assert long.frames == 1801 and long.fps == 30.0
    assert steps.max() < 0.1
    assert np.abs(long.root_pos[:, :2]).max() < 20.0
    alike = np.abs((long.rot[1:] * long.rot[:-1]).sum(-1))
    assert np.degrees(2 * np.arccos(alike.clip(max=1.0))).max() < 25.0
    assert np.array_equal(long.root_pos, lengths.joined([walk, walk], 1.0, 0).root_pos)


def test_a_command_is_timed_and_a_failure_told():
    row, _, said = lengths.run([sys.executable, "-c", "print('done')"])
    assert said.strip() == "done" and row["wall_s"] > 0 and row["peak_mb"] > 1
    with pytest.raises(SystemExit, match="gone wrong"):
        lengths.run([sys.executable, "-c", "print('gone wrong'); raise SystemExit(2)"])
