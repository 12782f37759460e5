"""What a motion needs that is not there, on poses made for it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from poise.body import BodyTable, generate_table
from poise.formats import read_clip
from poise.kinematics.forward import poses_of
from poise.kinematics.ground import fit_heights
from poise.kinematics.repair.needs import Need, find_needs
from poise.motion import Clip, shifted
from toy_human import human, swing, turn

FPS = 30.0


def posed(seconds: float = 3.0, lean: float = 0.0, **angles: float) -> Clip:
    """A still pose, the whole body tilted by `lean`, with turns of joints about Y in degrees; a joint's
    name without a side is both."""
    clip = swing(seconds, FPS)
    rot = np.zeros_like(clip.rot)
    rot[..., 0] = 1.0
    for name, degrees in {"Hips": lean, **angles}.items():
        for joint in (name, f"Left{name}", f"Right{name}"):
            if joint in human().names:
                angle = np.full((clip.frames,), math.radians(degrees))
                rot[:, human().index(joint)] = turn("Y", angle)
    return clip.replaced(rot=rot, root_pos=np.tile(clip.root_pos[0], (clip.frames, 1)))


def needs(clip: Clip, height: np.ndarray | float = 0.0) -> list[Need]:
    """What a clip needs, standing on the floor or `height` m above it."""
    table: BodyTable = generate_table(clip.skeleton, None, [clip])
    lift = -float(fit_heights(table, *poses_of(clip, table), clip.fps).before_m)
    path = np.zeros((clip.frames, 3))
    path[:, 2] = lift + height
    return list(find_needs(table, *poses_of(shifted(clip, path), table), clip.fps))


SITS = {"UpLeg": -90.0, "Leg": 90.0}


def test_a_chair_that_is_not_there_is_a_seat():
    (need,) = needs(posed(**SITS))
    assert need.what == "a seat" and need.start_s == 0.0 and need.stop_s == pytest.approx(3.0, abs=0.2)
    assert need.clause().startswith("it needs a seat from 0.0 to ")


def test_a_stool_is_a_seat_too():
    assert [n.what for n in needs(posed(**SITS), 0.4)] == ["a seat"]


def test_arms_that_reach_in_the_way_of_the_weight_hold_something():
    """Hands on a wall, or on a rail behind a body that leans back."""
    assert [n.what for n in needs(posed(lean=35, Arm=-125.0))] == ["something to hold"]
    assert [n.what for n in needs(posed(lean=-35, Arm=-55.0))] == ["something to hold"]


def test_without_reaching_hands_the_weight_is_unsupported():
    (need,) = needs(posed(lean=35))
    assert need.what == "a support" and need.clause().startswith("its weight is unsupported from 0.0")


def test_above_the_floor_hands_feet_and_motion_tell_what_bears_the_weight():
    assert [n.what for n in needs(posed(Arm=-180.0), 0.5)] == ["something to hold"]
    assert [n.what for n in needs(posed(), 0.5)] == ["something to stand on"]
    circle = 0.5 + 0.2 * np.sin(np.linspace(0, 3 * np.pi, 91))
    assert [n.what for n in needs(posed(), circle)] == ["to be carried"]


def test_only_the_seconds_without_a_floor_are_named():
    height = np.zeros(91)
    height[30:70] = 0.5
    (need,) = needs(posed(), height)
    assert (need.start_s, need.stop_s) == pytest.approx((1.0, 2.3))


@pytest.mark.parametrize(
    "clip",
    [
        posed(),
        posed(Arm=-90.0),
        posed(Arm=-180.0),
        posed(lean=90.0),
        posed(lean=-90.0),
        posed(UpLeg=-90.0, lean=0.0),
        swing(3.0, FPS),
        swing(3.0, FPS, speed=1.2),
    ],
    ids=["stands", "reaches", "arms up", "prone", "supine", "sits on the floor", "swings", "glides"],
)
def test_what_a_body_can_do_alone_needs_nothing(clip: Clip):
    assert needs(clip) == []


@pytest.mark.parametrize(
    "name",
    [
        "deepmimic_txt/humanoid3d_cartwheel.txt",
        "deepmimic_txt/humanoid3d_crawl.txt",
        "deepmimic_txt/humanoid3d_getup_faceup.txt",
        "other/bandai_bvh/dataset-1_dash_chimpira_001.bvh",
        "cmu_bvh/acrnn_salsa/21.bvh",
    ],
)
def test_real_motions_on_a_floor_need_nothing(data_dir, name):
    clip = read_clip(data_dir / name)
    table = generate_table(clip.skeleton, None, [clip])
    lift = fit_heights(table, *poses_of(clip, table), clip.fps).lift_m
    assert find_needs(table, *poses_of(shifted(clip, (0.0, 0.0, lift)), table), clip.fps) == ()
