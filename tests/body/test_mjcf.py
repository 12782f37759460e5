"""A body of the user's own: what is taken from the file, what is refused and how."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from benchmarks.common.stance import relaxed_stance
from poise.body import BodyConfig, make_humanoid, read_mjcf
from poise.kinematics import Kinematics, fit_humanoid
from poise.recipes.residual_force import build
from poise.recipes.residual_force_settings import ResidualForce
from refusals import refused
from rigs import rig


def limb(side: str, sign: float, foot_axis: str = "0 1 0") -> str:
    """A leg with three hip hinges, a knee and an ankle."""
    return f"""
    <body name="{side}_thigh" pos="0 {sign * 0.1} -0.05">
      <joint name="{side}_hip_x" axis="1 0 0" range="-30 30"/>
      <joint name="{side}_hip_z" axis="0 0 1" range="-40 40"/>
      <joint name="{side}_hip_y" axis="0 1 0" range="-110 40"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".06" mass="5"/>
      <body name="{side}_shin" pos="0 0 -.42">
        <joint name="{side}_knee" axis="0 -1 0" range="-150 2" armature="0.02" damping="3"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".045" mass="3"/>
        <body name="{side}_foot" pos="0 0 -.4">
          <joint name="{side}_ankle" axis="{foot_axis}" range="-45 45"/>
          <joint name="{side}_ankle_x" axis="1 0 0" range="-20 20"/>
          <geom type="box" pos=".05 0 -.05" size=".13 .045 .02" mass="1"/>
        </body>
      </body>
    </body>"""


def arm(side: str, sign: float, elbow: str = "hinge") -> str:
    return f"""
    <body name="{side}_upper_arm" pos="0 {sign * 0.2} .42">
      <joint axis="1 0 0" range="-120 120"/><joint axis="0 1 0" range="-120 60"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.27" size=".035" mass="2"/>
      <body name="{side}_forearm" pos="0 0 -.28">
        <joint name="{side}_elbow" type="{elbow}" axis="0 1 0" range="-140 5"/>
        <geom type="ellipsoid" pos="0 0 -.12" size=".035 .035 .12" mass="1.2"/>
        <body name="{side}_hand" pos="0 0 -.25"><geom type="sphere" size=".04" mass=".4"/></body>
      </body>
    </body>"""


def mjcf(
    root: str = "<freejoint/>", elbow: str = "hinge", foot_axis: str = "0 1 0", more: str = ""
) -> str:
    limbs = "".join(
        limb(s, g, foot_axis) + arm(s, g, elbow) for s, g in (("left", 1.0), ("right", -1.0))
    )
    return f"""
<mujoco model="own">
  <compiler angle="degree"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body name="pelvis" pos="0 0 0.95">{root}
      <geom type="capsule" fromto="0 -.08 0 0 .08 0" size=".09" mass="14"/>{limbs}
      <body name="head" pos="0 0 .5"><geom type="sphere" pos="0 0 .12" size=".1" mass="4"/></body>
    </body>
    {more}
  </worldbody>
  <actuator>
    <position joint="left_knee" kp="700" forcerange="-90 90"/>
    <motor joint="right_knee" gear="110" ctrlrange="-1 1"/>
  </actuator>
  <contact><exclude body1="left_foot" body2="right_foot"/></contact>
</mujoco>"""


BALL = (
    """<mujoco><worldbody><body name="ball"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
)


def written(tmp_path, text: str):
    path = tmp_path / "own.xml"
    path.write_text(text)
    return path


def test_what_the_file_says_is_what_the_body_is(tmp_path):
    own = read_mjcf(written(tmp_path, mjcf()))
    humanoid = make_humanoid(own.skeleton, own.table)
    reference = mujoco.MjModel.from_xml_string(mjcf())
    assert humanoid.mass == pytest.approx(reference.body_mass.sum())
    assert len(humanoid.hinges) == reference.njnt - 1
    rows = {r.name: r for r in own.table.rows}
    knee, other = rows["left_shin"], rows["right_shin"]
    assert (knee.kp, knee.torque, knee.kd, knee.armature) == (700.0, 90.0, 3.0, 0.02)
    assert other.torque == 110.0 and other.kp > 0
    assert knee.ranges[0] == pytest.approx(np.radians([-150, 2]))
    kinds = {n: (r.kind, r.side) for n, r in rows.items()}
    assert kinds["left_foot"] == ("foot", "left") and kinds["right_hand"] == ("hand", "right")
    assert kinds["pelvis"] == ("pelvis", "") and kinds["head"] == ("head", "")
    assert own.table.contact_exclusions == (("left_foot", "right_foot"),)
    told = " ".join(own.notes)
    assert "The ellipsoid of body 'left_forearm' became the box around it." in told
    assert "Position servos were added to" in told


def test_it_moves_as_the_file_does(tmp_path):
    # The same hinge angles put every body at the same place in MuJoCo's own model of the file.
    own = read_mjcf(written(tmp_path, mjcf()))
    model = mujoco.MjModel.from_xml_string(mjcf())
    data = mujoco.MjData(model)
    angles = np.random.default_rng(0).uniform(-0.5, 0.5, model.nq - 7)
    data.qpos[7:] = angles
    mujoco.mj_kinematics(model, data)
    qpos = np.concatenate((data.qpos[:7], angles))
    state = Kinematics(own.table)(qpos)
    np.testing.assert_allclose(state.pos, data.xpos[1:], atol=1e-9)
    made = make_humanoid(own.skeleton, own.table).model
    there = mujoco.MjData(made)
    there.qpos[:] = qpos
    mujoco.mj_kinematics(made, there)
    np.testing.assert_allclose(there.xpos, data.xpos, atol=1e-9)


def test_it_stands_and_takes_a_clip_of_another_skeleton(tmp_path):
    path = written(tmp_path, mjcf())
    own = read_mjcf(path)
    stance = relaxed_stance(make_humanoid(own.skeleton, own.table))
    assert stance.margin_m > 0.03 and stance.tilt_deg < 1
    clip = rig("mixamo", "T", fingers=True).clip(size=0.2)
    humanoid, motions, report = fit_humanoid(clip, BodyConfig(mjcf=str(path)))
    assert humanoid.bodies == tuple(r.name for r in own.table.rows)
    # Fewer hinges than the source has cannot follow everything.
    assert report.clips[0].joint_error_mm < 60 and np.isfinite(motions[0]).all()
    imitation = build(clip, ResidualForce(body=BodyConfig(mjcf=str(path)), num_envs=2))
    assert imitation.library.clips[0].skeleton.names == own.skeleton.names
    env = imitation.env(2, threads=1)
    obs = env.reset()
    assert obs is not None
    env.close()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (mjcf(root=""), ("no-free-root",)),
        (
            mjcf(elbow="ball").replace('range="-140 5"', ""),
            ("joint-unsupported", ("left_elbow", "left_forearm", "ball")),
        ),
        (mjcf(elbow="slide"), ("joint-unsupported", ("left_elbow", "left_forearm", "slide"))),
        (mjcf(foot_axis="1 1 0"), ("joint-unsupported", ("left_foot", "45"))),
        (mjcf().replace("</worldbody>", "</worldbdy>"), ("mjcf-unreadable",)),
        (mjcf().replace('kp="700"', 'kp="many"'), ("mjcf-unreadable", "line")),
        (BALL, ("role-missing", ("left foot", "ball"))),
        (
            mjcf(more='<body><geom type="mesh" mesh="m"/></body>').replace(
                "<worldbody>", '<asset><mesh name="m" file="gone.stl"/></asset><worldbody>'
            ),
            ("mjcf-unreadable", "gone.stl"),
        ),
    ],
    ids=["no-free", "ball", "slide", "skew", "xml", "line", "no-foot", "mesh"],
)
def test_what_does_not_fit_is_told_in_a_sentence(tmp_path, text, message):
    path = written(tmp_path, text)
    with refused(*message) as error:
        read_mjcf(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_and_two_masses_are_told(tmp_path):
    with refused("file-missing"):
        read_mjcf(tmp_path / "none.xml")
    with refused("settings-conflict"):
        BodyConfig(mass_kg=70.0, mjcf="own.xml")


def test_hinges_a_little_off_are_set_right_with_a_note(tmp_path):
    own = read_mjcf(written(tmp_path, mjcf(foot_axis="0.3 1 0")))
    assert any("'left_foot'" in n and "17 degrees off right angles" in n for n in own.notes)


def test_a_body_without_hands_gets_joints_for_their_tips(tmp_path):
    text = mjcf()
    for side in ("left", "right"):
        start = text.index(f'<body name="{side}_hand"')
        text = text[:start] + text[text.index("</body>", start) + len("</body>") :]
    own = read_mjcf(written(tmp_path, text))
    assert own.skeleton.names[-2:] == ("left_hand", "right_hand")
    assert len(own.table.rows) == len(own.skeleton) - 2
    np.testing.assert_allclose(own.skeleton.offsets[-1], [0.0, 0.0, -0.24], atol=1e-6)


def asset(line: str) -> str:
    return above(f"<asset>{line}</asset>")


def above(line: str) -> str:
    return mjcf().replace("<worldbody>", f"{line}<worldbody>")


BOMB = '<texture name="t" type="2d" builtin="flat" width="60000" height="60000"/>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (above('<include file="../x.xml"/>'), ("outside-folder",)),
        (above('<include file="/etc/passwd"/>'), ("outside-folder",)),
        (asset('<mesh name="m" file="../../m.stl"/>'), ("outside-folder", "../../m.stl")),
        (above('<extension><plugin plugin="x"/></extension>'), ("content-refused",)),
        (asset(BOMB), ("over-limit", ("<texture>", "3.6e+09"))),
        (asset('<hfield nrow="40000" ncol="40000" size="1 1 1 1"/>'), ("over-limit", "1.6e+09")),
        (above('<size nuserdata="2000000000"/>'), ("over-limit", "<size>")),
        (above('<size nkey="2000000000"/>'), ("over-limit", "<size>")),
        (mjcf(more='<replicate count="100000"><body/></replicate>'), ("over-limit", "1e+05")),
        (mjcf(more='<flexcomp type="grid" count="300 300 300"/>'), ("over-limit", "2.7e+07")),
        (mjcf(more="<body>" * 300 + "</body>" * 300), ("nested-too-deep", "200")),
        ('<!DOCTYPE a [<!ENTITY x "y">]>' + mjcf(), ("content-refused",)),
        ("", ("file-empty",)),
        ("<mujoco>" + "<geom/>" * 50_001 + "</mujoco>", ("over-limit", "50000")),
    ],
)  # fmt: skip
def test_files_from_strangers_are_limited(tmp_path, text, message):
    path = written(tmp_path, text)
    with refused(*message) as error:
        read_mjcf(path)
    said = str(error.value)
    assert said.startswith(str(path)) and len(said) < len(str(path)) + 200


def test_what_lies_in_its_folder_is_included(tmp_path):
    text = mjcf()
    start, end = text.index("<worldbody>"), text.index("</worldbody>") + len("</worldbody>")
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts/body.xml").write_text(f"<mujoco>{text[start:end]}</mujoco>")
    path = written(tmp_path, text[:start] + '<include file="parts/body.xml"/>' + text[end:])
    assert len(read_mjcf(path).skeleton) == len(read_mjcf(written(tmp_path, text)).skeleton)
