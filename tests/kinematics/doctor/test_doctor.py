"""Planted faults are found where they are and mended; what was fine is left alone."""

from __future__ import annotations

import math
from functools import lru_cache
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import pytest
from planted_faults import (
    cut,
    drift,
    exchanged,
    excursion,
    frozen,
    lifted,
    repeated,
    shaken,
    teleport,
    turned,
)

from poise.formats import read_clip
from poise.kinematics import Fault, examine, heal, swap_sides
from poise.motion import Clip
from poise.motion.rotations import quat_distance


@pytest.fixture(scope="module")
def home() -> Clip:
    """The walk that comes with Poise, 30 Hz."""
    with as_file(files("poise") / "data/walk.bvh") as path:
        return read_clip(path)


@pytest.fixture(scope="module")
def cmu(data_dir: Path) -> Clip:
    """A captured walk, 120 Hz."""
    return read_clip(data_dir / "cmu_amc/02/02_01.amc")


@pytest.fixture(params=["home", "cmu"])
def walk(request: pytest.FixtureRequest) -> Clip:
    return request.getfixturevalue(request.param)


#: What is seen of a clip; its faults and figures are asked for one by one.
seen_in = lru_cache(maxsize=8)(examine)


def found(clip: Clip, kind: str) -> list[Fault]:
    return [f for f in seen_in(clip).faults if f.kind == kind]


def figure(clip: Clip, name: str) -> float:
    value = seen_in(clip).figures[name]
    assert value is not None
    return value


def apart_m(a: Clip, b: Clip) -> float:
    return float(np.linalg.norm(a.positions() - b.positions(), axis=-1).max())


def apart_deg(a: Clip, b: Clip) -> float:
    return math.degrees(float(quat_distance(a.rot, b.rot).max()))


def foot(clip: Clip) -> str:
    return "LeftFoot" if "LeftFoot" in clip.skeleton.names else "lfoot"


def arm(clip: Clip) -> str:
    return "LeftArm" if "LeftArm" in clip.skeleton.names else "lhumerus"


def test_a_clean_clip_comes_back_as_it_is(walk: Clip) -> None:
    seen = examine(walk)
    assert seen.faults == () and seen.judged
    assert heal(walk) is walk


def test_a_teleport_is_found_and_joined(walk: Clip) -> None:
    k = walk.frames // 2
    broken = teleport(walk, k, 0.5)
    (fault,) = found(broken, "teleport")
    assert (fault.start, fault.stop, fault.joint) == (k, k, walk.skeleton.names[0])
    assert fault.size == pytest.approx(0.5, abs=0.06)
    fixed = heal(broken)
    assert found(fixed, "teleport") == []
    assert apart_m(fixed, walk) < 0.015


def test_a_leap_of_the_height_keeps_the_floor(walk: Clip) -> None:
    k = walk.frames // 2
    path = np.array(walk.root_pos)
    path[k:, 2] += 0.5
    fixed = heal(walk.replaced(root_pos=path))
    assert apart_m(fixed, walk) < 0.03


def test_a_path_that_leaves_and_comes_back_is_bridged(walk: Clip) -> None:
    first, last = walk.frames // 2, walk.frames // 2 + round(0.1 * walk.fps)
    broken = excursion(walk, first, last)
    assert {f.start for f in found(broken, "teleport")} == {first, last + 1}
    fixed = heal(broken)
    assert found(fixed, "teleport") == [] and apart_m(fixed, walk) < 0.03
    np.testing.assert_allclose(fixed.root_pos[-1], walk.root_pos[-1], atol=1e-9)


def test_a_flip_is_found_and_turned_back(walk: Clip) -> None:
    first, last = walk.frames // 3, walk.frames // 2
    broken = turned(walk, foot(walk), first, last, (0.0, math.pi, 0.0))
    (fault,) = found(broken, "flip")
    assert (fault.joint, fault.start, fault.stop) == (foot(walk), first, last)
    assert apart_deg(heal(broken), walk) < 3.0


def test_a_drifting_root_makes_feet_slide_until_it_is_mended(walk: Clip) -> None:
    broken = drift(walk, 0.5)
    slides = found(broken, "foot slide")
    assert {f.joint for f in slides} == {
        foot(walk),
        foot(walk).replace("Left", "Right").replace("lf", "rf"),
    }
    assert min(f.size for f in slides) > 4.0
    fixed = heal(broken)
    assert found(fixed, "foot slide") == []
    before, after = (figure(c, "sole_slide_mm_per_s") for c in (broken, fixed))
    assert before > 400 and after < 0.35 * before
    # The walk's own slip is no fault; the mended one has little more.
    assert after < figure(walk, "sole_slide_mm_per_s") + 60
    # Where the path has to stay, legs alone hold the feet as far as they reach.
    held = heal(broken, path=False)
    np.testing.assert_array_equal(held.root_pos[:, :2], broken.root_pos[:, :2])
    assert figure(held, "sole_slide_mm_per_s") < before


def test_a_floating_clip_is_lowered(walk: Clip) -> None:
    broken = lifted(walk, 0.05)
    (fault,) = found(broken, "float")
    assert (fault.joint, fault.start, fault.stop) == ("", 0, walk.frames - 1)
    assert fault.size == pytest.approx(5.0, abs=2.0)
    fixed = heal(broken)
    assert found(fixed, "float") == []
    assert figure(fixed, "float_mm") < figure(walk, "float_mm") + 15
    assert apart_m(fixed, walk) < 0.025


def test_a_sunken_clip_is_lifted(walk: Clip) -> None:
    broken = lifted(walk, -0.03)
    assert found(broken, "penetration")
    fixed = heal(broken)
    assert found(fixed, "penetration") == []
    assert figure(fixed, "penetration_max_mm") < 0.7 * figure(broken, "penetration_max_mm")


def test_jitter_is_found_at_its_joint_and_smoothed(walk: Clip) -> None:
    first, last = walk.frames // 3, walk.frames // 3 + round(0.8 * walk.fps)
    broken = shaken(walk, arm(walk), first, last, 2.0)
    faults = found(broken, "jitter")
    assert {f.joint for f in faults} == {arm(walk)}
    reach = round(0.15 * walk.fps) + 8
    assert all(first - reach <= f.start and f.stop <= last + reach for f in faults)
    fixed = heal(broken)
    assert found(fixed, "jitter") == []
    before, now = (figure(c, "jerk_m_per_s3") - figure(walk, "jerk_m_per_s3") for c in (broken, fixed))
    assert now < 0.25 * before
    assert apart_deg(fixed, walk) < apart_deg(broken, walk)
    still = np.r_[0 : first - 2 * reach, last + 2 * reach : walk.frames]
    np.testing.assert_allclose(fixed.rot[still], walk.rot[still], atol=1e-9)


@pytest.mark.parametrize("count", [1, 3])
def test_frames_put_in_twice_are_left_out(walk: Clip, count: int) -> None:
    k = walk.frames // 2
    broken = repeated(walk, k, count)
    (fault,) = found(broken, "frozen frames")
    assert (fault.start, fault.stop) == (k + 1, k + count)
    fixed = heal(broken)
    assert fixed.frames == walk.frames and apart_m(fixed, walk) < 1e-9


@pytest.mark.parametrize("count", [1, 3])
def test_lost_frames_are_filled_in(walk: Clip, count: int) -> None:
    k = walk.frames // 2
    broken = frozen(walk, k, count)
    (fault,) = found(broken, "frozen frames")
    assert (fault.start, fault.stop) == (k + 1, k + count)
    fixed = heal(broken)
    assert fixed.frames == walk.frames and apart_m(fixed, walk) < 0.5 * apart_m(broken, walk)
    assert found(fixed, "frozen frames") == []


def test_missing_frames_are_told(walk: Clip) -> None:
    k = walk.frames // 2
    (fault,) = found(cut(walk, k, 3), "missing frames")
    # At 30 Hz the limbs turn round within the gap, so that fewer usual steps seem to fit into it.
    assert fault.start == k and (1 if walk.fps < 60 else 2) <= fault.size <= 4


def test_exchanged_sides_are_told_and_undone_on_demand(walk: Clip) -> None:
    broken = exchanged(walk)
    (fault,) = found(broken, "sides")
    assert "--swap-sides" in fault.detail
    back = swap_sides(broken)
    assert back.skeleton.names == walk.skeleton.names and found(back, "sides") == []


def test_several_faults_at_once(walk: Clip) -> None:
    k = walk.frames // 2
    broken = lifted(drift(teleport(walk, k, 0.5), 0.3), 0.06)
    fixed = heal(broken)
    assert examine(fixed).faults == ()
