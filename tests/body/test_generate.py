"""The generated body: masses, shapes, hinges, overrides, and how it stands."""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from poise.body import BodyConfig, Humanoid, generate_table, make_humanoid
from poise.body.body_table import HARD_S
from poise.formats import read_clip
from poise.kinematics import Kinematics, contact_labels, fit_humanoid, lowest_height
from poise.motion import Clip, trim
from poise.motion.rotations import quat_rotate
from poise.motion.vectors import lower_median
from poise.sim import alone
from refusals import refused
from toy_human import human, swing

#: Short real clips of every dialect, the ASF of those that need one, hinges and bodies.
CLIPS = {
    "cmu_amc/02/02_01.amc": ("", 32, 20),
    "cmu_amc/rfc/90_02.amc": ("cmu_amc/rfc/08.asf", 32, 20),
    "cmu_bvh/ad/back_handspring1_autolabel.bvh": ("", 48, 19),
    "other/bandai_bvh/dataset-1_walk-right_angry_001.bvh": ("", 45, 19),
    "other/mass_bvh/walk.bvh": ("", 45, 19),
    "noisy/rokoko_video/jesse_dance.bvh": ("", 48, 20),
    "deepmimic_txt/humanoid3d_walk.txt": ("", 28, 15),
}


def load(folder, name: str) -> Clip:
    asf = CLIPS[name][0]
    clip = read_clip(folder / name, skeleton=folder / asf if asf else None)
    return trim(clip, 0, min(clip.frames, 360))


@pytest.fixture(scope="module")
def fitted(data_dir):
    """`fitted(name)`: (humanoid, qpos, report) of a real clip, made once."""
    known: dict[str, tuple] = {}

    def make(name: str):
        if name not in known:
            humanoid, motions, report = fit_humanoid(load(data_dir, name))
            known[name] = humanoid, motions[0], report
        return known[name]

    return make


def neutral(humanoid: Humanoid) -> np.ndarray:
    qpos = np.zeros(humanoid.model.nq)
    qpos[3] = 1.0
    qpos[2] = 3.0
    return qpos


def check_sound(humanoid: Humanoid) -> None:
    table, model = humanoid.table, humanoid.model
    assert tuple(model.body(i + 1).name for i in range(len(table.rows))) == humanoid.bodies
    assert tuple(model.joint(i + 1).name for i in range(model.njnt - 1)) == humanoid.hinges
    assert tuple(model.actuator(i).name for i in range(model.nu)) == humanoid.hinges
    assert model.body_mass.sum() == pytest.approx(table.mass)
    for row in table.rows:
        assert row.mass > 0.02 and row.geoms
        for geom in row.geoms:
            used = {"capsule": 2, "box": 3, "sphere": 1}[geom.kind]
            assert min(geom.size[:used]) > 0.003 and max(geom.size) < 0.6
            assert np.linalg.norm(geom.quat) == pytest.approx(1.0)
        assert all(a < b for a, b in row.ranges)
        assert not row.order or (row.kp > 0 and row.kd > 0 and row.torque > 0)
    assert (model.body_inertia[1:] > 0).all()


@pytest.mark.parametrize("name", CLIPS)
def test_every_real_skeleton_gets_a_sound_body(fitted, name):
    humanoid, qpos, report = fitted(name)
    check_sound(humanoid)
    assert len(humanoid.hinges) == CLIPS[name][1] and len(humanoid.bodies) == CLIPS[name][2]
    assert 1.4 < humanoid.table.height_m < 2.0 and 45 < humanoid.mass < 90
    assert report.clips[0].joint_error_mm < 1.0 and np.isfinite(qpos).all()
    low = [r.ranges[i][0] for r in humanoid.table.rows for i in range(len(r.order))]
    high = [r.ranges[i][1] for r in humanoid.table.rows for i in range(len(r.order))]
    assert (qpos[:, 7:] >= low).all() and (qpos[:, 7:] <= high).all()


@pytest.mark.parametrize("name", CLIPS)
def test_nothing_but_the_floor_touches_in_the_motion(fitted, name):
    humanoid, qpos, _ = fitted(name)
    data = mujoco.MjData(humanoid.model)
    # DeepMimic's arms hang through its hips where all angles are zero; no motion goes there.
    still = [] if "deepmimic" in name else [neutral(humanoid)]
    for frame in [*qpos[::10], *still]:
        data.qpos[:] = frame
        mujoco.mj_forward(humanoid.model, data)
        for contact in data.contact:
            own = bool(humanoid.model.geom_bodyid[contact.geom].all())
            # Limbs that brush each other may; deeper ones are excluded by the fit.
            assert not own or contact.dist > -0.0101


@pytest.mark.parametrize("name", CLIPS)
def test_left_and_right_are_alike(fitted, name):
    table = fitted(name)[0].table
    for kind in ("thigh", "shin", "foot", "upper_arm", "forearm", "hand"):
        of_side = {r.side: r for r in table.rows if r.kind == kind}
        left, right = of_side["left"], of_side["right"]
        assert left.mass == pytest.approx(right.mass, rel=0.03)
        assert (left.kp, left.kd, left.torque) == (right.kp, right.kd, right.torque)
        np.testing.assert_allclose(left.geoms[0].size, right.geoms[0].size, rtol=0.1, atol=0.006)


def test_the_toy_is_mirrored_exactly():
    table = generate_table(human())
    flip = np.array([1.0, -1.0, 1.0])
    for left in (r for r in table.rows if r.side == "left"):
        right = table.rows[table.index(left.name.replace("Left", "Right"))]
        np.testing.assert_allclose(left.pos, flip * right.pos, atol=1e-12)
        np.testing.assert_allclose(left.geoms[0].size, right.geoms[0].size)
        np.testing.assert_allclose(left.geoms[0].pos, flip * right.geoms[0].pos, atol=1e-9)
    assert table.height_m == pytest.approx(0.82 / 0.491)
    assert table.mass == pytest.approx(22.0 * table.height_m**2)


@pytest.mark.parametrize("mass", [31.0, 80.0])
def test_a_stated_mass_is_met_and_strength_follows(mass):
    table = generate_table(human(), BodyConfig(mass_kg=mass))
    assert table.mass == pytest.approx(mass)
    thigh = table.rows[table.index("LeftUpLeg")]
    assert thigh.kp == pytest.approx(500.0 * mass / 31.0)
    assert thigh.torque == pytest.approx(200.0 * mass / 31.0)
    assert thigh.kd == pytest.approx(0.02 * thigh.kp)
    model = make_humanoid(human(), table).model
    assert model.body_mass.sum() == pytest.approx(mass)


def test_the_model_says_what_the_table_says():
    humanoid = make_humanoid(human(), generate_table(human()))
    model, k = humanoid.model, 0
    for row in humanoid.table.rows:
        for (low, high), name in zip(row.ranges, row.hinge_names(), strict=True):
            joint = model.joint(name)
            assert joint.range.tolist() == pytest.approx([low, high])
            assert float(joint.damping[0]) == row.kd and float(joint.armature[0]) == row.armature
            assert model.actuator_gainprm[k, 0] == row.kp == -model.actuator_biasprm[k, 1]
            # No damping in the actuator: saturation must not take it away.
            assert model.actuator_biasprm[k, 2] == 0
            assert model.actuator_forcerange[k].tolist() == [-row.torque, row.torque]
            k += 1
    assert k == model.nu and model.nv == 6 + k


def test_overrides_by_body_and_by_part():
    changes = (("LeftFoot.kp", 400.0), ("thigh.torque", 99.0))
    table = generate_table(human(), BodyConfig(overrides=changes))
    assert table.rows[table.index("LeftFoot")].kp == 400.0
    assert table.rows[table.index("RightFoot")].kp != 400.0
    assert [r.torque for r in table.rows if r.kind == "thigh"] == [99.0, 99.0]
    assert table.overridden({"friction": 0.7}).friction == 0.7
    # A softer body is so on the floor, too, and is the same body to a checkpoint.
    soft = make_humanoid(human(), table.overridden({"soft_s": 0.05}))
    hard = make_humanoid(human(), table)
    assert soft.identity == hard.identity
    assert soft.model.geom_solref[:, 0].tolist() == [0.05] * soft.model.ngeom
    assert (soft.model.geom_solmix > 10).all() and (hard.model.geom_solref[:, 0] == HARD_S).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"LeftFoto.kp": 1.0}, ("unknown-body", ("LeftFoto", "LeftFoot"))),
        ({"LeftFoot.colour": 1.0}, ("unknown-setting", "LeftFoot.colour")),
        ({"kp": 1.0}, ("unknown-setting", "kp")),
        ({"LeftFoot.kp": -1.0}, ("out-of-range", "-1.0")),
        ({"LeftFoot.kp": math.nan}, ("out-of-range", "nan")),
    ],
)
def test_wrong_overrides_are_told(changes, message):
    with refused(*message):
        generate_table(human()).overridden(changes)


def test_wrong_settings_and_skeletons_are_told():
    with refused("out-of-range", says=("mass_kg", "0.5")):
        BodyConfig(mass_kg=0.5)
    with refused("unknown-choice", says=("preset", "robot")):
        BodyConfig(preset="robot")
    flat = replace(human(), offsets=np.zeros((len(human()), 3)))
    with refused("limb-too-short", says="0.0"):
        generate_table(flat)


def test_rows_out_of_order_are_refused():
    table = generate_table(human())
    rows = table.rows
    # The second arm before the first one's forearm: a tree, but not depth first.
    arm, fore = table.index("LeftArm"), table.index("LeftForeArm")
    later = replace(rows[arm], name="Extra", geoms=rows[arm].geoms)
    rest = (replace(r, parent=r.parent + (r.parent > arm)) for r in rows[fore:])
    moved = (*rows[: arm + 1], later, *rest)
    with refused("body-table-order"):
        make_humanoid(human(), replace(table, rows=moved, contact_exclusions=()))


def test_the_identity_follows_the_body():
    table = generate_table(human())
    same = make_humanoid(human(), generate_table(human())).identity
    assert make_humanoid(human(), table).identity == same
    renamed = replace(human(), names=("Pelvis", *human().names[1:]))
    others = {
        make_humanoid(human(1.1), generate_table(human(1.1))).identity,
        make_humanoid(human(), generate_table(human(), BodyConfig(mass_kg=70.0))).identity,
        make_humanoid(renamed, generate_table(renamed)).identity,
    }
    assert len(others | {same}) == 4


def test_named_rows():
    humanoid = make_humanoid(human(), generate_table(human()))
    names = humanoid.bodies
    assert [names[i] for i in humanoid.feet] == ["LeftFoot", "RightFoot"]
    assert {names[i] for i in humanoid.end_effectors} == {
        "LeftFoot", "RightFoot", "LeftHand", "RightHand", "Head",
    }  # fmt: skip
    assert len(humanoid.table.describe()) == len(names)


def stand(humanoid: Humanoid, qpos: np.ndarray, seconds: float) -> tuple[float, float]:
    """Seconds until the centre of mass is below three quarters of its height, and the top speed."""
    model = alone(humanoid)
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = qpos, qpos[7:]
    mujoco.mj_forward(model, data)
    start, fell, speed = data.subtree_com[1, 2], seconds, 0.0
    for k in range(round(seconds * 60)):
        mujoco.mj_step(model, data)
        speed = max(speed, float(np.abs(data.qvel).max()))
        if data.subtree_com[1, 2] < 0.75 * start:
            fell = min(fell, k / 60)
    assert np.isfinite(data.qpos).all() and not data.warning.number.any()
    return fell, speed


@pytest.mark.parametrize("name", CLIPS)
def test_a_pose_held_by_servos_alone_never_explodes(fitted, name):
    # Measured: it takes 1 to 2 s to tip over from the first frame of a walk, top speed below 10 rad/s.
    humanoid, qpos, _ = fitted(name)
    _, speed = stand(humanoid, qpos[0], 3.0)
    assert speed < 30.0


def test_the_toy_stands_still():
    humanoid = make_humanoid(human(), generate_table(human()))
    qpos = neutral(humanoid)
    state = Kinematics(humanoid.table)(qpos[None])
    qpos[2] -= float(lowest_height(humanoid.table, state.pos, state.quat).min())
    fell, speed = stand(humanoid, qpos, 2.0)
    assert fell == 2.0 and speed < 3.0


def as_double(values: tuple[float, ...]) -> np.ndarray:
    return np.asarray(values, dtype=float)


def soles(humanoid: Humanoid, qpos: np.ndarray, foot: int) -> np.ndarray:
    """`(T, 4, 3)` m, the corners of a foot's lower face."""
    state, geom = Kinematics(humanoid.table)(qpos), humanoid.table.rows[foot].geoms[0]
    x, y, z = geom.size
    face = np.array([[i * x, j * y, -z] for i in (-1, 1) for j in (-1, 1)], dtype=float)
    local = as_double(geom.pos) + quat_rotate(np.broadcast_to(as_double(geom.quat), (4, 4)), face)
    turn = state.quat[:, foot, None]
    return state.pos[:, foot, None] + quat_rotate(turn, np.broadcast_to(local, (len(qpos), 4, 3)))


@pytest.mark.parametrize("name", ["cmu_amc/02/02_01.amc", "deepmimic_txt/humanoid3d_walk.txt"])
def test_standing_feet_are_level_and_near_the_floor(fitted, name):
    # The lift follows the standing soles; the two feet of a clip may still stand a little apart in
    # height, and the smooth lift of toes that sink at push-off reaches into the stance.
    humanoid, qpos, _ = fitted(name)
    for foot in humanoid.feet:
        corners = soles(humanoid, qpos, foot)
        stands = contact_labels(corners.mean(1)[:, None], 30.0, height=0.06, speed=0.25)[:, 0]
        heights = corners[stands][..., 2]
        assert int(stands.sum()) >= 5
        assert float(lower_median(heights.max(1) - heights.min(1))) < 0.025
        assert abs(float(lower_median(heights.mean(1)))) < 0.015


def test_the_toys_soles_are_flat_on_the_floor():
    humanoid, motions, _ = fit_humanoid(swing())
    for foot in humanoid.feet:
        heights = soles(humanoid, motions[0], foot)[..., 2]
        assert float(np.abs(heights).min()) < 0.02 and float(heights.max()) < 0.09
