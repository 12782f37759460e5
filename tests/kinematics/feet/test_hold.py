"""Standing feet stay where they stand, and nothing else is touched."""

from __future__ import annotations

from importlib.resources import as_file, files

import numpy as np
import pytest

from poise.body import BodyTable, generate_table
from poise.formats import read_clip
from poise.kinematics import anatomy_of, hold_feet, lowest_height
from poise.kinematics import hold as feet_hold
from poise.kinematics.hold import led
from poise.kinematics.repair.support import FloorPoints
from poise.metrics import foot_slide
from poise.motion import Clip


@pytest.fixture(scope="module")
def walk() -> Clip:
    """The walk that comes with Poise, 30 Hz."""
    with as_file(files("poise") / "data/walk.bvh") as path:
        return read_clip(path)


@pytest.fixture(scope="module")
def table(walk: Clip) -> BodyTable:
    return generate_table(walk.skeleton, None, [walk])


def slide(clip: Clip, table: BodyTable) -> float:
    """mm/s of the soles."""
    return float(foot_slide(FloorPoints.of(clip, anatomy_of(clip), table).soles, clip.fps))


def standing(walk: Clip, table: BodyTable, frames: int = 60) -> Clip:
    """A frame of double support, held still, with its lowest sole on the floor."""
    lowest = _lowest(walk, table)
    k = int(np.abs(lowest[:, 0] - lowest[:, 1]).argmin())
    root = np.repeat(walk.root_pos[k : k + 1], frames, 0)
    root[:, 2] -= lowest[k].min()
    return walk.replaced(root_pos=root, rot=np.repeat(walk.rot[k : k + 1], frames, 0))


def _lowest(clip: Clip, table: BodyTable) -> np.ndarray:
    """Heights `(T, 2)` of the feet."""
    pos, quat = (x[:, [r.joint for r in table.rows]] for x in clip.world())
    feet = [i for i, r in enumerate(table.rows) if r.kind == "foot"]
    return lowest_height(table, pos, quat)[:, feet]


def test_what_stands_still_is_left_alone(walk: Clip, table: BodyTable) -> None:
    still = standing(walk, table)
    held, moved = hold_feet(still, table)
    assert moved.max_mm < 1e-6
    assert np.abs(held.positions() - still.positions()).max() < 1e-9


def test_a_body_that_sways_on_its_feet_keeps_them_in_place(walk: Clip, table: BodyTable) -> None:
    still = standing(walk, table)
    path = np.array(still.root_pos)
    path[:, 0] += 0.02 * np.sin(2 * np.pi * 1.0 * np.arange(still.frames) / still.fps)
    swaying = still.replaced(root_pos=path)
    held, moved = hold_feet(swaying, table)
    before, after = slide(swaying, table), slide(held, table)
    assert before > 60 and after < before / 10
    assert moved.max_mm < 45
    # Only legs move, and the root's path is the body's.
    assert np.array_equal(held.root_pos, swaying.root_pos)
    legs = {r.joint for r in table.rows if r.kind in ("thigh", "shin", "foot")}
    changed = np.flatnonzero(np.abs(held.rot - swaying.rot).max((0, 2)) > 1e-9)
    assert set(changed.tolist()) <= legs


def test_a_turning_body_keeps_its_soles_from_turning(walk: Clip, table: BodyTable) -> None:
    still = standing(walk, table)
    angle = np.radians(4.0) * np.sin(2 * np.pi * 1.0 * np.arange(still.frames) / still.fps)
    turn = np.stack((np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)), -1)
    from poise.motion.rotations import quat_mul

    rot = still.rot.copy()
    rot[:, 0] = quat_mul(turn, rot[:, 0])
    turning = still.replaced(rot=rot)
    held, _ = hold_feet(turning, table)
    assert slide(held, table) < slide(turning, table) / 5


def test_feet_in_the_air_and_dragged_feet_are_left_alone(walk: Clip, table: BodyTable) -> None:
    still = standing(walk, table)
    up = still.root_pos + np.array([0.0, 0.0, 0.5])
    t = np.arange(still.frames)[:, None] / still.fps
    for path in (up + t * [0.3, 0.0, 0.0], still.root_pos + t * [0.6, 0.0, 0.0]):
        moving = still.replaced(root_pos=path)
        held, moved = hold_feet(moving, table)
        assert moved.max_mm < 1e-6 and np.abs(held.rot - moving.rot).max() < 1e-9


def test_sunken_soles_are_lifted_out(walk: Clip, table: BodyTable) -> None:
    still = standing(walk, table)
    deep = np.array(still.root_pos)
    deep[20:40, 2] -= 0.02
    held, _ = hold_feet(still.replaced(root_pos=deep), table)
    assert _lowest(held, table).min() > -0.002


def test_the_walk_is_the_same_walk(walk: Clip, table: BodyTable) -> None:
    held, moved = hold_feet(walk, table)
    assert slide(held, table) < 0.5 * slide(walk, table) or slide(walk, table) < 10
    assert np.linalg.norm(held.positions() - walk.positions(), axis=-1).max() < 0.1
    assert moved.mean_mm < 30


def test_a_clip_of_two_frames_comes_back(walk: Clip, table: BodyTable) -> None:
    short = walk.replaced(root_pos=walk.root_pos[:2], rot=walk.rot[:2])
    assert hold_feet(short, table)[0] is short


def test_a_foot_whose_leg_would_whip_is_left(
    walk: Clip, table: BodyTable, monkeypatch: pytest.MonkeyPatch
) -> None:
    held, moved = hold_feet(walk, table)
    assert not moved.left and np.abs(held.rot - walk.rot).max() > 1e-4
    before = Clip.positions

    def swept(*told: object) -> np.ndarray:
        """Legs that are led turn by half a turn from one frame to the next."""
        rot = led(*told)  # type: ignore[arg-type]
        foot = next(iter(told[3]))  # type: ignore[call-overload]
        rot[1::2, walk.skeleton.parents[foot]] = np.array([0.0, 1.0, 0.0, 0.0], dtype=rot.dtype)
        return rot

    monkeypatch.setattr(feet_hold, "led", swept)
    left, moved = hold_feet(walk, table)
    feet = {walk.skeleton.names[r.joint] for r in table.rows if r.kind == "foot"}
    assert set(moved.left) == feet and moved.max_mm == 0.0
    assert np.abs(before(left) - before(walk)).max() < 1e-9
