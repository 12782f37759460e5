"""A rest pose for other tools: a T-pose with all rotations at zero, and the motion stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from poise.formats import read_clip, write_clip
from poise.kinematics import find_guesses, with_rest_pose
from poise.motion import Clip, Skeleton, trim
from poise.motion.roles import SIDES, find_roles
from poise.motion.rotations import normalize, quat_between, quat_mul, quat_rotate_inv
from refusals import refused
from toy_human import swing


def folded(clip: Clip, seed: int = 0) -> Clip:
    """The same motion with the frames of all joints turned at random, so that zero is no pose at all."""
    rng = np.random.default_rng(seed)
    turns = normalize(rng.normal(size=(len(clip.skeleton), 4)))
    parents = clip.skeleton.parents
    world = quat_mul(clip.world()[1], turns)
    local = [world[:, 0]] + [quat_between(world[:, p], world[:, j]) for j, p in enumerate(parents) if j]
    offsets = clip.skeleton.offsets
    above = turns[[max(p, 0) for p in parents]]
    ends = tuple(
        (j, tuple(quat_rotate_inv(turns[j], np.asarray(tip, dtype=float)).tolist()))
        for j, tip in clip.skeleton.ends
    )
    skeleton = replace(clip.skeleton, offsets=quat_rotate_inv(above, offsets), ends=ends)
    return clip.replaced(skeleton=skeleton, rot=np.stack(local, 1))


def check_t_pose(skeleton: Skeleton) -> None:
    """Arms aside, legs down, upright, facing along -Y."""
    roles, pos = find_roles(skeleton), skeleton.rest_positions()

    def of(role: str) -> np.ndarray:
        joint = roles.joint(role)
        assert joint is not None, role
        return pos[joint]

    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        for a, b, way in (
            ("upper_arm", "forearm", (sign, 0, 0)),
            ("forearm", "hand", (sign, 0, 0)),
            ("thigh", "shin", (0, 0, -1)),
            ("shin", "foot", (0, 0, -1)),
        ):
            bone = of(f"{side}_{b}") - of(f"{side}_{a}")
            assert bone @ way > 0.999 * np.linalg.norm(bone), (side, a)
        toes = roles.joint(f"{side}_toes")
        if toes is not None:
            assert pos[toes][1] < of(f"{side}_foot")[1]
    spine = of("head") - of("hips")
    assert spine[2] > 0.95 * np.linalg.norm(spine)


def in_order(clip: Clip, like: Clip) -> np.ndarray:
    """The places of a clip's joints in the order of another clip's."""
    return clip.positions()[:, [clip.skeleton.names.index(n) for n in like.skeleton.names]]


@pytest.mark.parametrize("turned", [False, True])
def test_a_t_pose_at_zero_and_the_same_motion(tmp_path: Path, turned: bool) -> None:
    source = swing(1.0, 30.0, speed=1.0)
    clip = folded(source) if turned else source
    made, evidence, degrees = with_rest_pose(clip)
    assert ("mean pose" in evidence) == turned and (degrees > 30.0)
    check_t_pose(made.skeleton)
    assert np.abs(made.positions() - source.positions()).max() < 1e-9
    assert made.skeleton.names == clip.skeleton.names and made.skeleton.parents == clip.skeleton.parents
    write_clip(made, tmp_path / "a.bvh")
    back = read_clip(tmp_path / "a.bvh", unit_m=0.01, up_axis="Y")
    assert np.abs(back.positions() - in_order(source, back)).max() < 1e-3
    check_t_pose(back.skeleton)
    (rest,) = (g for g in find_guesses(back) if g.what == "rest pose")
    assert rest.value == "T-pose"
    # Once more changes nothing that matters.
    again = with_rest_pose(made).clip
    assert np.abs(again.skeleton.offsets - made.skeleton.offsets).max() < 0.02


@pytest.mark.parametrize(
    "name",
    ["lafan1_bvh/walk4_subject1.bvh", "other/bandai_bvh/dataset-1_dash_happy_001.bvh",
     "cmu_bvh/ad/frontkick001.bvh", "cmu_amc/02/02_01.amc"],
)  # fmt: skip
def test_real_files_that_lie_folded_at_rest(data_dir: Path, tmp_path: Path, name: str) -> None:
    clip = trim(read_clip(data_dir / name), 0, 90)
    made = with_rest_pose(clip).clip
    check_t_pose(made.skeleton)
    write_clip(made, tmp_path / "a.bvh")
    source = made.skeleton.source
    up, unit = (source.up_axis, source.unit_m) if source.format == "bvh" else ("Y", 0.01)
    back = read_clip(tmp_path / "a.bvh", unit_m=unit, up_axis=up)
    assert np.abs(back.positions() - in_order(clip, back)).max() < 1e-3
    check_t_pose(back.skeleton)
    # The joint that carried the travel carries it still.
    assert back.skeleton.source.travel_joint == source.travel_joint


def test_what_is_no_human_has_no_t_pose() -> None:
    skeleton = Skeleton(("a", "b"), (-1, 0), np.array([[0, 0, 0], [0, 0, 1.0]]))
    rot = np.zeros((3, 2, 4))
    rot[..., 0] = 1.0
    with refused("role-missing"):
        with_rest_pose(Clip(skeleton, np.zeros((3, 3)), rot, 30.0))
