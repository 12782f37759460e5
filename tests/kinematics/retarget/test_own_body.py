"""A body of one topology takes the bones of any skeleton, and motions lie on it as on their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from poise.body import BodyConfig, Humanoid, generate_table, make_humanoid
from poise.kinematics import place_on_body, retarget
from poise.kinematics.retargeting.own_body import onto_own, own_body, own_skeleton
from poise.motion import Clip, Skeleton
from poise.motion.roles import map_joints
from refusals import refused
from toy_human import human, swing

LIMBS = ("thigh", "shin", "foot", "upper_arm", "forearm", "hand")


def core() -> tuple[Humanoid, Clip]:
    """The toy human as the topology, and a clip on it."""
    example = swing(2.0, 30.0)
    return make_humanoid(example.skeleton, generate_table(example.skeleton, None, (example,))), example


def own(clip: Clip) -> tuple[Humanoid, Clip]:
    """The core with the bones of a clip, and the example on it."""
    base, example = core()
    table, there = own_body(clip, base.table, example)
    return make_humanoid(there.skeleton, table), there


def other() -> Clip:
    """A motion of a human with one spine joint, other proportions, and fingers."""
    small = human(0.8)
    offsets = small.offsets.copy()
    for name, factor in (("LeftLeg", 1.2), ("RightLeg", 1.2), ("LeftHand", 0.8), ("RightHand", 0.8)):
        offsets[small.index(name)] *= factor
    skeleton = Skeleton(
        (*small.names, "LeftHandIndex1"),
        (*small.parents, small.index("LeftHand")),
        np.vstack((offsets, (0.0, 0.0, -0.1))),
        small.ends,
    )
    on = swing(2.0, 30.0)
    finger = np.tile((np.cos(0.3), np.sin(0.3), 0.0, 0.0), (on.frames, 1, 1))
    return Clip(skeleton, on.root_pos * 0.9, np.concatenate((on.rot, finger), 1), 30.0, "other")


def apart(a: Clip, b: Clip) -> float:
    """The largest distance of the joints of limbs, mm."""
    joints = map_joints(a.skeleton, b.skeleton)
    pairs = [joints.limb_pair(f"{side}_{kind}") for side in ("left", "right") for kind in LIMBS]
    x, y = np.transpose([p for p in pairs if p is not None])
    return float(np.linalg.norm(a.positions()[:, x] - b.positions()[:, y], axis=-1).max() * 1000)


def test_it_keeps_the_topology_and_takes_the_bones():
    base, _ = core()
    clip = other()
    body, there = own(clip)
    assert (body.bodies, body.hinges) == (base.bodies, base.hinges)
    assert [r.frame for r in body.table.rows] == [r.frame for r in base.table.rows]
    bone = np.linalg.norm(body.skeleton.offsets, axis=-1)
    wanted = np.linalg.norm(clip.skeleton.offsets, axis=-1)
    for name in ("LeftLeg", "RightFoot", "LeftForeArm", "RightHand"):
        assert bone[body.skeleton.index(name)] == pytest.approx(wanted[clip.skeleton.index(name)])
    # As tall as its legs say, as heavy as that height says, and as strong.
    alone = generate_table(clip.skeleton, None, (clip,))
    assert body.table.height_m == pytest.approx(alone.height_m)
    assert body.mass == pytest.approx(alone.mass, rel=1e-6)
    assert there.skeleton is body.skeleton
    # The feet stand as the clip's do.
    soles = [t.rows[t.index("LeftFoot")].geoms[0].size for t in (body.table, alone)]
    np.testing.assert_allclose(soles[0], soles[1], rtol=1e-3)


def test_a_motion_goes_there_and_back_without_error():
    clip = other()
    body, there = own(clip)
    how = onto_own(body.table)
    moved, report = retarget(clip, there, config=how)
    assert apart(clip, moved) < 0.01 and report.scale == 1.0
    assert apart(clip, retarget(moved, clip, config=how, example=there)[0]) < 0.01
    on = place_on_body(clip, body.table, there, how=how, clean=False, level=False, near=body)
    # The toy's limbs have hinges for all of its turns.
    assert on.joint_error_mm < 0.01


def test_the_same_bones_are_the_same_body():
    base, example = core()
    assert own_body(example, base.table, example) == (base.table, example)
    # Without the short cut the skeleton comes out as it went in.
    made = own_skeleton(example, example)
    np.testing.assert_allclose(made.offsets[1:], base.skeleton.offsets[1:], atol=1e-9)


def test_a_spine_with_fewer_joints_moves_as_its_bones_do():
    clip = swing(2.0, 30.0)
    skeleton, names = clip.skeleton, [n for n in clip.skeleton.names if n != "Spine"]
    keep = [skeleton.index(n) for n in names]
    above = [skeleton.names[max(skeleton.parents[j], 0)].replace("Spine", "Hips") for j in keep]
    parents = (-1, *(names.index(n) for n in above[1:]))
    rot = clip.rot[:, keep].copy()
    rot[:, names.index("Chest")] = (np.cos(0.2), 0.0, np.sin(0.2), 0.0)
    few = Clip(Skeleton(tuple(names), parents, skeleton.offsets[keep]), clip.root_pos, rot, 30.0)
    body, there = own(few)
    shared, _ = retarget(few, there, config=replace(onto_own(body.table), share=True))
    exact, _ = retarget(few, there, config=onto_own(body.table))
    assert apart(few, exact) < 0.01 and apart(few, shared) > 5.0


def test_the_mass_can_be_stated_and_a_body_from_a_file_stays():
    base, example = core()
    body, _ = own_body(other(), base.table, example, BodyConfig(mass_kg=40.0))
    assert body.mass == pytest.approx(40.0)
    with refused("settings-conflict"):
        own_body(other(), base.table, example, BodyConfig(mjcf="body.xml"))
