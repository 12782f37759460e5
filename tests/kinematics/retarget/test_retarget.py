"""A motion on another skeleton: identities, hand-made skeletons, real clips."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from poise.body.topology import subtree
from poise.formats import read_clip
from poise.kinematics import RetargetConfig, retarget
from poise.kinematics.feet import rest_height
from poise.kinematics.limbs import match_positions
from poise.kinematics.retargeting.common_pose import common_pose
from poise.kinematics.retargeting.plant import BLEND_S, contact_weight
from poise.kinematics.retargeting.standing import ClipWorld, hinge_axis
from poise.motion import Clip, Skeleton, find_roles, resample, trim
from poise.motion.rotations import (
    euler_to_quat,
    normalize,
    quat_conj,
    quat_distance,
    quat_mul,
    quat_rotate,
)
from refusals import refused
from toy_human import human, swing

CLIPS = {
    "bandai": "other/bandai_bvh/dataset-2_walk_active_005.bvh",
    "lafan": "lafan1_bvh/walk4_subject1.bvh",
    "cmu": "cmu_amc/02/02_01.amc",
    "salsa": "cmu_bvh/acrnn_salsa/01.bvh",
    "deepmimic": "deepmimic_txt/humanoid3d_walk.txt",
    "mass": "other/mass_bvh/walk.bvh",
    "jacks": "cmu_bvh/ad/jumping_jacks.bvh",
}
_CACHE: dict[str, Clip] = {}


def real(data_dir, name: str) -> Clip:
    """Up to 120 frames of a real clip at 30 Hz or more."""
    if name not in _CACHE:
        _CACHE[name] = trim(read_clip(data_dir / CLIPS[name]), 0, 240)
    return _CACHE[name]


def turned(clip: Clip, axes: np.ndarray | None = None) -> Clip:
    """The same motion on a skeleton of joints with other axes, by default such that it lies folded at
    rest, as LAFAN1's does."""
    if axes is None:
        generator = np.random.default_rng(0)
        axes = generator.normal(size=(len(clip.skeleton), 4))
    axes = normalize(axes)
    parents = clip.skeleton.parents
    # A joint's world rotation W becomes W A; its child's offset is seen in the frame turned by A.
    offsets = clip.skeleton.offsets
    rot = clip.rot.copy()
    new_offsets, new_rot = offsets.copy(), rot.copy()
    for j, p in enumerate(parents):
        before = axes[p] if p >= 0 else np.array([1.0, 0, 0, 0], dtype=float)
        new_offsets[j] = quat_rotate(quat_conj(before), offsets[j])
        new_rot[:, j] = quat_mul(
            quat_mul(np.broadcast_to(quat_conj(before), rot[:, j].shape), rot[:, j]), axes[j]
        )
    ends = tuple(
        (j, tuple(quat_rotate(quat_conj(axes[j]), np.asarray(v, dtype=float)).tolist()))
        for j, v in clip.skeleton.ends
    )
    skeleton = Skeleton(clip.skeleton.names, parents, new_offsets, ends)
    return Clip(skeleton, clip.root_pos, normalize(new_rot), clip.fps, clip.name, clip.cyclic)


def renamed(skeleton: Skeleton, names: dict[str, str]) -> Skeleton:
    return Skeleton(
        tuple(names.get(n, n) for n in skeleton.names),
        skeleton.parents,
        skeleton.offsets,
        skeleton.ends,
    )


def walk(scale: float = 1.0) -> Clip:
    return swing(seconds=2.0, speed=1.0, scale=scale, name="walk")


def test_onto_itself_changes_nothing() -> None:
    clip = walk()
    made, report = retarget(clip, clip.skeleton)
    assert np.abs(made.positions() - clip.positions()).max() < 1e-9
    assert float(quat_distance(*(c.rot for c in (made, clip))).max()) < 1e-6
    assert report.scale == 1.0 and report.direction_max_deg < 1e-6 and report.end_percent < 1e-9
    assert (made.fps, made.name, made.cyclic) == (clip.fps, clip.name, clip.cyclic)


@pytest.mark.parametrize("name", CLIPS)
def test_real_clips_onto_themselves_change_nothing(name: str, data_dir) -> None:
    clip = real(data_dir, name)
    made, _ = retarget(clip, clip)
    assert np.abs(made.positions() - clip.positions()).max() < 1e-7
    assert float(quat_distance(*(c.rot for c in (made, clip))).max()) < math.radians(0.01)


def test_a_giant_takes_the_same_steps_at_its_size() -> None:
    clip = walk()
    made, report = retarget(clip, human(2.0))
    assert report.scale == pytest.approx(2.0)
    np.testing.assert_allclose(made.rot, clip.rot, atol=1e-9)
    np.testing.assert_allclose(
        np.diff(made.positions(), axis=0), 2 * np.diff(clip.positions(), axis=0), atol=1e-9
    )
    # It starts above the same spot.
    np.testing.assert_allclose(made.root_pos[0, :2], clip.root_pos[0, :2], atol=1e-9)
    assert report.end_percent < 1e-9


def test_other_axes_of_the_joints_do_not_matter() -> None:
    clip = walk()
    other = turned(clip)
    np.testing.assert_allclose(other.positions(), clip.positions(), atol=1e-12)
    plain = RetargetConfig(contacts=False, clear=False)
    for a, b in ((clip, other), (other, clip)):
        made, report = retarget(a, b, config=plain)
        assert report.direction_max_deg < 1e-4
        # Folded, it stands as it does on average, which is not quite as it does at rest.
        assert np.abs(made.positions() - clip.positions()).max() < 0.04
        # Elbows and knees turn about the target's own hinge, whatever axes it has.
        for joint in ("LeftForeArm", "RightLeg"):
            j = b.skeleton.index(joint)
            rot, own = (c.rot[:, j] for c in (made, b))
            assert float(quat_distance(rot, own).max()) < math.radians(3.0)


@pytest.mark.parametrize("axis", ["X", "Y"])
def test_a_rest_pose_may_lie_on_the_floor(axis: str) -> None:
    clip = walk()
    quarter = euler_to_quat(np.array([[math.pi / 2]], dtype=float), axis)
    lying = turned(clip, np.broadcast_to(quarter, (len(clip.skeleton), 4)))
    assert np.ptp(lying.skeleton.rest_positions()[:, 2]) < 0.6
    for a, b in ((clip, lying.skeleton), (lying, clip.skeleton)):
        made, report = retarget(a, b)
        assert report.poses == ("its rest pose stands", "its rest pose stands")
        np.testing.assert_allclose(made.positions(), clip.positions(), atol=1e-6)


def test_a_folded_skeleton_needs_a_clip_unless_the_names_agree() -> None:
    clip = walk()
    folded = turned(clip).skeleton
    names = {"LeftArm": "LeftUpperArm", "RightArm": "RightUpperArm"}
    with refused("rest-pose-unknown"):
        retarget(clip, renamed(folded, names))
    # Another subject of the same rig: the source shows how it stands.
    bigger = Skeleton(folded.names, folded.parents, folded.offsets * 1.1)
    made, report = retarget(turned(clip), bigger)
    assert report.scale == pytest.approx(1.1) and report.direction_max_deg < 1e-4
    assert made.skeleton is bigger


def spine(count: int) -> Skeleton:
    """The toy human with another number of spine joints over the same length."""
    base = human()
    rows = [("Hips", "", (0.0, 0.0, 0.0))]
    for k in range(count):
        rows.append((f"Spine{k}", rows[-1][0], (0.0, 0.0, 0.32 / count)))
    top = rows[-1][0]
    for j, name in enumerate(base.names):
        if name in ("Hips", "Spine", "Chest"):
            continue
        parent = base.names[base.parents[j]]
        rows.append((name, top if parent == "Chest" else parent, tuple(base.offsets[j])))
    names = [r[0] for r in rows]
    parents = tuple(names.index(r[1]) if r[1] else -1 for r in rows)
    return Skeleton(tuple(names), parents, np.array([r[2] for r in rows]))


@pytest.mark.parametrize("count", [1, 2, 4, 7])
def test_the_bend_of_a_spine_is_shared_out(count: int) -> None:
    clip = walk()
    rot = np.array(clip.rot)
    bend = euler_to_quat(np.linspace(0, 0.6, clip.frames)[:, None], "Y")
    rot[:, clip.skeleton.index("Spine")] = bend
    rot[:, clip.skeleton.index("Chest")] = bend
    made, _ = retarget(clip.replaced(rot=rot), spine(count))
    joints = [made.skeleton.index(f"Spine{k}") for k in range(count)]
    chest = made.world()[1][:, joints[-1]]
    wanted = clip.replaced(rot=rot).world()[1][:, clip.skeleton.index("Chest")]
    assert float(quat_distance(chest, wanted).max()) < 1e-6
    # Every joint takes a share in the same direction.
    shares = 2 * np.arctan2(made.rot[-1, joints, 2], made.rot[-1, joints, 0])
    assert (np.abs(shares) > 0.05).all() and (np.sign(shares) == 1).all()
    assert shares.sum() == pytest.approx(1.2, abs=0.02)


def test_missing_toes_head_and_clavicles_are_no_obstacle() -> None:
    clip = walk()
    full = clip.skeleton
    kept = [j for j, n in enumerate(full.names) if not n.endswith(("Toe", "Head", "Neck"))]
    poor = Skeleton(
        tuple(full.names[j] for j in kept),
        tuple(kept.index(full.parents[j]) if full.parents[j] >= 0 else -1 for j in kept),
        full.offsets[kept],
    )
    made, report = retarget(clip, poor)
    assert report.direction_deg < 1.5
    assert report.joints.unused() == ("Neck", "Head", "LeftToe", "RightToe")
    back, again = retarget(made, clip)
    assert "LeftToe" in again.joints.still()
    assert np.abs(back.positions() - clip.positions())[:, full.index("LeftHand")].max() < 0.03


def sway() -> Clip:
    """Both feet stand still under hips that sway."""
    clip = swing(seconds=2.0)
    root, rot = clip.arrays()
    names = clip.skeleton.names
    for joint in ("Hips", *(f"{s}{x}" for s in ("Left", "Right") for x in ("UpLeg", "Leg"))):
        rot[:, names.index(joint)] = np.array([1.0, 0.0, 0.0, 0.0], dtype=float)
    stand = clip.replaced(rot=rot).positions()[0]
    t = np.linspace(0, 4 * math.pi, clip.frames)
    root[:, 0], root[:, 1] = 0.05 * np.sin(t), 0.04 * np.cos(t)
    root[:, 2] = root[:, 2] - 0.06
    stays: dict[int | str, np.ndarray] = {
        j: np.broadcast_to(stand[j], root.shape)
        for j in (names.index("LeftFoot"), names.index("RightFoot"))
    }
    held = match_positions(clip.skeleton, rot, root, stays)
    return clip.replaced(rot=held, root_pos=root)


def test_standing_feet_stay_where_they_stand() -> None:
    # Legs of other proportions and wider hips would drag the feet about.
    clip = sway()
    offsets = np.array(human().offsets)
    names = human().names
    for side in ("Left", "Right"):
        offsets[names.index(f"{side}UpLeg")] *= 1.3
        offsets[names.index(f"{side}Leg")] *= 0.9
        offsets[names.index(f"{side}Foot")] *= 1.15
    other = Skeleton(names, human().parents, offsets)
    _, without = retarget(clip, other, config=RetargetConfig(contacts=False, clear=False))
    _, report = retarget(clip, other)
    assert without.direction_max_deg < 1e-6
    assert report.contact_s > 3.0 and report.slide_mm_s[0] < 0.1
    assert without.slide_mm_s[1] > 1.0
    assert report.slide_mm_s[1] < 0.1
    assert report.direction_deg < 5.0


def test_nothing_sinks_deeper_than_in_the_source() -> None:
    # A squat: the legs fold, and the body comes down by as much as they do.
    clip = swing(seconds=1.0)
    frames = clip.frames
    fold = np.linspace(0, 1.2, frames)
    rot = np.array(clip.rot)
    root = np.array(clip.root_pos)
    for side in ("Left", "Right"):
        for joint, share in (("UpLeg", -1.0), ("Leg", 2.0), ("Foot", -1.0)):
            turn = euler_to_quat(share * fold[:, None], "Y")
            rot[:, clip.skeleton.index(side + joint)] = turn
    root[:, 2] = 0.87 - 0.82 * (1 - np.cos(fold))
    squat = clip.replaced(rot=rot, root_pos=root)
    offsets = np.array(clip.skeleton.offsets)
    offsets[clip.skeleton.index("LeftToe")] = (0.2, 0.0, -0.09)
    other = Skeleton(clip.skeleton.names, clip.skeleton.parents, offsets)
    _, free = retarget(squat, other, config=RetargetConfig(contacts=False, clear=False))
    _, cleared = retarget(squat, other, config=RetargetConfig(contacts=False))
    assert free.depth_max_mm[1] > free.depth_max_mm[0] + 5
    assert cleared.depth_max_mm[1] <= cleared.depth_max_mm[0] + 0.5


def test_pairs_by_hand_overrule_guesses_and_wrong_ones_are_refused() -> None:
    clip = walk()
    strange = renamed(human(), {"LeftUpLeg": "Peter", "LeftLeg": "Paul", "LeftFoot": "Mary"})
    with refused("role-missing", says="left_thigh, left_shin, left_foot"):
        retarget(clip, strange)
    stated = {"LeftUpLeg": "Peter", "LeftLeg": "Paul", "LeftFoot": "Mary"}
    _, report = retarget(clip, strange, stated)
    assert report.direction_max_deg < 1e-6
    by_role = {"left_thigh": "Peter", "left_shin": "Paul", "left_foot": "Mary"}
    assert retarget(clip, strange, by_role)[1].direction_max_deg < 1e-6
    with refused("unknown-joint", says=("target", "Petr", "Peter")):
        retarget(clip, strange, stated | {"LeftUpLeg": "Petr"})
    with refused("unknown-joint", says=("source", "LeftUpLg")):
        retarget(clip, strange, {"LeftUpLg": "Peter"})
    with refused("hierarchy-reversed"):
        retarget(clip, human(2.0), {"LeftUpLeg": "LeftLeg", "LeftLeg": "LeftUpLeg"})
    with refused("joint-mapped-twice", says=("LeftUpLeg", "LeftLeg", "Peter")):
        retarget(clip, strange, {"LeftUpLeg": "Peter", "LeftLeg": "Peter"})


def test_skeletons_that_no_human_has_are_refused_in_a_sentence() -> None:
    clip = walk()
    base = human()

    def changed(name: str, value: tuple[float, float, float]) -> Skeleton:
        offsets = np.array(base.offsets)
        offsets[base.index(name)] = value
        return Skeleton(base.names, base.parents, offsets)

    legless = Skeleton(
        ("Hips", "Spine", "Head"), (-1, 0, 1), np.array([[0, 0, 0], [0, 0, 0.3], [0, 0, 0.3]])
    )
    with refused("role-missing", says="left_thigh"):
        retarget(clip, legless)
    with refused("zero-length-bone", says="left"):
        retarget(clip, changed("LeftLeg", (0, 0, 0)))
    narrow = np.array(base.offsets)
    for side in ("Left", "Right"):
        narrow[base.index(f"{side}UpLeg")] = 0.0
    with refused("facing-unknown"):
        retarget(clip, Skeleton(base.names, base.parents, narrow))
    swapped = {"LeftToe": "RightToe", "RightToe": "LeftToe"}
    for part in ("UpLeg", "Leg", "Foot"):
        swapped |= {f"Left{part}": f"Right{part}", f"Right{part}": f"Left{part}"}
    with refused("sides-swapped"):
        retarget(clip, renamed(base, swapped))
    # A forearm of no length points nowhere, and the rest works.
    made, report = retarget(clip, changed("LeftHand", (0, 0, 0)))
    assert np.isfinite(made.rot).all() and "left forearm" not in [b[0] for b in report.bones]


def test_a_root_above_the_hips_is_left_alone(data_dir) -> None:
    clip, bandai = real(data_dir, "cmu"), real(data_dir, "bandai")
    made, _ = retarget(clip, bandai)
    np.testing.assert_allclose(made.rot[:, 0], np.tile(bandai.rot[0, 0], (clip.frames, 1)), atol=1e-9)


@pytest.mark.parametrize("a", ["bandai", "cmu", "salsa", "jacks"])
@pytest.mark.parametrize("b", ["lafan", "deepmimic", "mass"])
def test_pairs_of_real_skeletons(a: str, b: str, data_dir) -> None:
    made, report = retarget(real(data_dir, a), real(data_dir, b))
    assert report.direction_deg < 4.0 and report.direction_max_deg < 30.0
    assert report.trunk_deg < 5.0
    assert report.slide_mm_s[1] <= 1.1 * report.slide_mm_s[0] + 2.0
    assert report.depth_max_mm[1] <= report.depth_max_mm[0] + 1.0
    step = quat_distance(made.rot[1:], made.rot[:-1])
    assert float(step.max()) < math.radians(60)


@pytest.mark.parametrize("b", ["lafan", "salsa", "mass"])
def test_there_and_back_again(b: str, data_dir) -> None:
    clip, other = real(data_dir, "bandai"), real(data_dir, b)
    made, _ = retarget(clip, other)
    back, _ = retarget(made, clip, example=other)
    error = np.linalg.norm(back.positions() - clip.positions(), axis=-1)
    assert error.mean() < 0.005 and error.max() < 0.06


def test_deepmimics_hinges_stay_hinges(data_dir) -> None:
    made, _ = retarget(real(data_dir, "salsa"), real(data_dir, "deepmimic"))
    for joint in ("left_elbow", "right_elbow", "left_knee", "right_knee"):
        q = made.rot[:, made.skeleton.index(joint)]
        # How much of the turn is not about the hinge (y): radians.
        off = 2 * np.arcsin(np.clip(np.hypot(q[:, 1], q[:, 3]), 0, 1))
        assert np.median(off) < math.radians(12), joint


def test_the_example_must_be_on_the_same_skeleton() -> None:
    with refused("skeleton-differs"):
        retarget(walk(), human(2.0), example=walk(1.5))


def test_the_common_pose_stands_with_flat_feet() -> None:
    clip = walk()
    for c in (clip, turned(clip)):
        pose = common_pose(find_roles(c.skeleton), c)
        at = {n: pose.pos[j] for j, n in enumerate(c.skeleton.names)}
        hips = (at["LeftUpLeg"] + at["RightUpLeg"]) / 2
        np.testing.assert_allclose(hips, 0, atol=1e-9)
        np.testing.assert_allclose(at["LeftFoot"] - at["LeftUpLeg"], (0, 0, -0.82), atol=1e-6)
        reach = (at["LeftHand"] - at["LeftArm"]) / 0.54
        np.testing.assert_allclose(reach, (0, math.sqrt(0.5), -math.sqrt(0.5)), atol=1e-6)
        assert at["LeftToe"][1] == pytest.approx(at["LeftFoot"][1], abs=1e-6)
        assert at["LeftToe"][0] > at["LeftFoot"][0] + 0.1
    assert pose.hip_height == pytest.approx(0.87, abs=0.02)


def test_a_hinge_is_seen_only_where_a_limb_bends() -> None:
    clip = walk()
    limb = tuple(clip.skeleton.index(f"Left{x}") for x in ("Arm", "ForeArm", "Hand"))
    assert len(limb) == 3
    axis = hinge_axis(ClipWorld.of(clip), limb)
    # The toy's elbow turns by negative angles about its y, arms hanging.
    assert axis is not None
    np.testing.assert_allclose(axis, (0, -1, 0), atol=1e-9)
    still = np.array(clip.rot)
    still[:, limb[1]] = (1, 0, 0, 0)
    assert hinge_axis(ClipWorld.of(clip.replaced(rot=still)), limb) is None


def test_contact_weights_rise_and_fall_smoothly() -> None:
    contact = np.zeros(90, dtype=bool)
    contact[40:50] = True
    weight = contact_weight(contact, 60.0)
    assert (weight[40:50] == 1).all()
    reach = round(BLEND_S * 60)
    assert float(weight[: 41 - reach].max()) == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(np.flip(weight[20:40], 0), weight[50:70], atol=1e-12)
    assert float(np.abs(np.diff(weight)).max()) < 0.2
    assert float(contact_weight(np.zeros(5, dtype=bool), 30.0).max()) == 0


def test_the_ground_is_where_feet_rest() -> None:
    t = np.linspace(0, 4 * math.pi, 240)
    points = np.zeros((240, 2, 3))
    for k, phase in enumerate((0.0, math.pi)):
        points[:, k, 2] = 0.03 + 0.2 * np.maximum(np.sin(t + phase), 0)
        points[:, k, 0] = np.where(np.sin(t + phase) > 0, t, 0.0)
    assert rest_height(points, 60.0) == pytest.approx(0.03, abs=2e-3)


def test_what_hangs_on_a_joint_is_its_subtree() -> None:
    s = human()
    assert {s.names[j] for j in subtree(s, s.index("LeftLeg"))} == {"LeftLeg", "LeftFoot", "LeftToe"}


def test_the_report_is_plain_data_and_sentences() -> None:
    _, report = retarget(walk(), human(2.0))
    text = json.dumps(report.to_dict(), allow_nan=False)
    assert json.loads(text)["scale"] == pytest.approx(2.0)
    assert {row["role"] for row in report.to_dict()["mapping"]} >= {"hips", "left_thigh", "head"}
    said = " ".join(report.sentences())
    assert "Steps are scaled by 2.000" in said and "its rest pose stands" in said


def test_another_rate_gives_the_same_path(data_dir) -> None:
    clip, other = real(data_dir, "cmu"), real(data_dir, "jacks")
    fast, _ = retarget(clip, other)
    slow, _ = retarget(resample(clip, 60.0), other)
    error = np.linalg.norm(fast.positions()[::2][: slow.frames] - slow.positions(), axis=-1)
    assert error.mean() < 0.01
