"""Feet that still slide in what is written."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from poise.formats import read_clip
from poise.jobs import deliver as module
from poise.jobs.deliver import settled
from poise.kinematics import examine
from poise.motion import Clip


@pytest.fixture(scope="module")
def walk() -> Clip:
    return read_clip(Path(str(files("poise") / "data/walk.bvh")))


def slides(clip: Clip) -> list[str]:
    return [f.joint for f in examine(clip).faults if f.kind == "foot slide"]


@pytest.fixture(scope="module")
def drifting(walk: Clip) -> Clip:
    """The walk on a floor that moves by 0.3 m/s."""
    root = walk.root_pos.copy()
    root[:, 1] += 0.3 * np.arange(walk.frames) / walk.fps
    return walk.replaced(root_pos=root)


def test_feet_that_slide_are_held_and_nothing_else_moves(walk: Clip, drifting: Clip) -> None:
    assert not slides(walk) and slides(drifting)
    still = settled(drifting, walk)
    assert len(slides(still)) < len(slides(drifting))
    np.testing.assert_array_equal(still.root_pos, drifting.root_pos)
    names = still.skeleton.names
    moved = {names[j] for j in np.flatnonzero(np.abs(still.rot - drifting.rot).max((0, 2)) > 1e-6)}
    assert moved and all(("Leg" in n or "Foot" in n or "Toe" in n) for n in moved), moved


def test_slides_of_the_source_stay(walk: Clip, drifting: Clip) -> None:
    np.testing.assert_array_equal(settled(drifting, drifting).rot, drifting.rot)
    np.testing.assert_array_equal(settled(walk, walk).rot, walk.rot)


def test_a_foot_is_left_where_holding_it_would_jerk(
    walk: Clip, drifting: Clip, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "ROUGHER", 0.0)
    np.testing.assert_array_equal(settled(drifting, walk).rot, drifting.rot)
