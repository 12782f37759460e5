"""Rigs of all makers, with twist bones, fingers, helpers: told by name and, without names, by shape."""

from __future__ import annotations

import pytest

from poise.body import find_anatomy
from rigs import STYLES, Rig, rig

PARTS = ("clavicle", "upper_arm", "forearm", "hand", "thigh", "shin", "foot")


def found(anatomy) -> dict[str, int]:
    return {f"{p.kind} {p.side}".strip(): p.joint for p in anatomy.parts}


def expected(made: Rig) -> dict[str, int]:
    roles = made.roles
    limbs = {f"{k} {s}": roles[f"{k} {s}"] for k in PARTS for s in ("left", "right")}
    return {**limbs, **{k: roles[k] for k in ("pelvis", "neck", "head")}}


@pytest.mark.parametrize("twist", ["none", "side", "chain"])
@pytest.mark.parametrize("style", [s for s in STYLES if s != "numbers"])
def test_rigs_are_told_by_name(style, twist):
    made = rig(style, twist=twist, fingers=True, helpers=style == "unreal")
    anatomy = find_anatomy(made.skeleton)
    got = found(anatomy)
    want = expected(made)
    assert {k: got.get(k) for k in want} == want
    assert anatomy.of("spine") == (made.roles["spine"], made.roles["chest"])
    assert dict(anatomy.toes) == {s: made.roles[f"toe {s}"] for s in ("left", "right")}
    assert not anatomy.evidence


@pytest.mark.parametrize("twist", ["none", "side", "chain"])
@pytest.mark.parametrize("pose", ["I", "A", "T", "folded"])
@pytest.mark.parametrize("fingers", [False, True])
def test_without_names_shape_tells(pose, twist, fingers):
    made = rig("numbers", pose, twist, fingers)
    clips = [made.clip(size=0.05)] if pose == "folded" else []
    anatomy = find_anatomy(made.skeleton, clips)
    got = found(anatomy)
    want = expected(made)
    assert {k: got.get(k) for k in want} == want
    first, second = anatomy.evidence
    assert "No names tell the limbs" in first and "lowest" in first
    assert second == f"bone{made.roles['thigh left']:02d} is the left hip: the toes point ahead."


def test_joints_without_a_body_ride_on_the_nearest_one():
    made = rig("unreal", twist="chain", fingers=True, helpers=True)
    riders = find_anatomy(made.skeleton).riders(made.skeleton)
    names = made.skeleton.names
    words = {names[j]: names[on] for j, on in riders.items()}
    assert words["index_0l1"] == words["index_0l2"] == words["thumb_0l2"] == "hand_l"
    assert words["upperarm_r_twist_01"] == "upperarm_r"
    assert words["ball_r"] == "foot_r" and words["root"] == words["ik_foot_l"] == "pelvis"


def test_a_long_spine_keeps_five_bodies_and_its_chest():
    from toy_spine import long_spine

    skeleton = long_spine(12)
    anatomy = find_anatomy(skeleton)
    assert len(anatomy.of("spine")) == 5 and skeleton.names[anatomy.of("spine")[-1]] == "Spine11"
    # The longest bones remain.
    kept = {skeleton.names[j] for j in anatomy.of("spine")}
    assert {"Spine3", "Spine7"} <= kept
