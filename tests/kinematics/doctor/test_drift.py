"""A floor that drifts under the feet is told, mended, and told apart from stairs and slopes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import poise
from poise.formats import read_clip
from poise.kinematics.repair.motion_doctor import examine, heal
from poise.kinematics.repair.timing import drift_faults, find_drift, mend_drift
from poise.motion import Clip

WALK = Path(poise.__file__).parent / "data/walk.bvh"
FPS = 60.0


def raised(clip: Clip, heights: np.ndarray) -> Clip:
    return clip.replaced(root_pos=clip.root_pos + heights[:, None] * np.array([0.0, 0.0, 1.0]))


def soles(frames: int = 240, climb: float = 0.0) -> np.ndarray:
    """`(T)` lowest points of a walk: borne for 0.4 s each on one height, `climb` m higher each step,
    with a touch of roll."""
    t = np.arange(frames) / FPS
    step = np.floor(t / 0.4)
    return climb * step + 0.004 * np.sin(2 * np.pi * t / 0.4)


@pytest.mark.parametrize("total", [0.25, 0.15, -0.2, 0.6])
def test_a_steady_drift_is_measured(total: float) -> None:
    low = soles() + np.linspace(0.0, total, 240)
    drift = find_drift(low, FPS)
    assert drift is not None and drift.size_m == pytest.approx(total, abs=0.02)
    assert np.abs(low - drift.heights()).max() < 0.03
    (fault,) = drift_faults(low, FPS, np.zeros(240, dtype=bool))
    way = "rises" if total > 0 else "sinks"
    assert fault.kind == "float" and f"{way} steadily by" in fault.detail
    assert fault.size == pytest.approx(100 * abs(total), abs=2.0)


@pytest.mark.parametrize("climb", [0.0, 0.17, -0.17, 0.08])
def test_stairs_slopes_and_level_floors_are_none(climb: float) -> None:
    """A foot that bears stays at one height, however much the next one is higher."""
    assert find_drift(soles(climb=climb), FPS) is None


def test_jumps_and_short_clips_are_none() -> None:
    t = np.arange(240) / FPS
    assert find_drift(np.maximum(0.0, 0.4 * np.sin(2 * np.pi * t)), FPS) is None
    assert find_drift(np.linspace(0.0, 0.3, 20), FPS) is None


def test_a_crooked_drift_that_stays_is_named() -> None:
    """What no line fits is not mended; beyond the height at which a body stands on something, it is told
    by its steady rise."""
    low = soles() + np.concatenate((np.zeros(120), np.linspace(0.0, 0.5, 120)))
    assert find_drift(low, FPS) is None
    (fault,) = drift_faults(low, FPS, np.zeros(240, dtype=bool))
    assert fault.kind == "float" and fault.start > 120 and fault.stop == 239


@pytest.mark.parametrize("total", [0.25, -0.2])
def test_the_doctor_mends_a_drift(total: float) -> None:
    clip = read_clip(WALK)
    drifting = raised(clip, np.linspace(0.0, total, clip.frames))
    faults = [f for f in examine(drifting).faults if f.kind == "float" and "steadily" in f.detail]
    assert len(faults) == 1 and faults[0].size == pytest.approx(100 * abs(total), abs=4.0)
    healed = heal(drifting)
    rest = healed.root_pos[:, 2] - clip.root_pos[:, 2]
    assert np.ptp(rest) < 0.05 and np.abs(rest).max() < 0.06
    assert not [f for f in examine(healed).faults if "steadily" in f.detail]


def test_a_clean_walk_stays_as_it_is() -> None:
    clip = read_clip(WALK)
    from poise.kinematics.repair.support import anatomy_of, support_of

    support = support_of(clip, anatomy_of(clip))
    assert support is not None and mend_drift(clip, support.sole_low) is clip
