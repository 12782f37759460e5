"""ASF/AMC: hand-computed poses, which skeleton is taken, and one take in two formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from handmade_motion_files import ASF, amc_text, put
from scipy.spatial.transform import Rotation

from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from poise.motion import Clip, describe, trim
from poise.motion.rotations import forward_kinematics

UNIT = 0.0254 / 0.45


def pair(folder: Path) -> Path:
    put(folder, "7.asf", ASF)
    return put(folder, "7_01.amc", amc_text())


def test_skeleton_of_bones(tmp_path: Path) -> None:
    clip = read_clip(pair(tmp_path))
    s = clip.skeleton
    assert s.names == ("root", "spine", "head", "lfemur", "lfoot")
    assert s.parents == (-1, 0, 1, 0, 3)
    # A bone starts at its parent's tip: the head at the spine's, the foot at the femur's.
    np.testing.assert_allclose(s.offsets[1], 0)
    np.testing.assert_allclose(s.offsets[2], [0, 0, 9 * UNIT], atol=1e-12)
    np.testing.assert_allclose(s.offsets[4], [4.8 * UNIT, 0, -6.4 * UNIT], atol=1e-12)
    assert [s.names[j] for j, _ in s.ends] == ["head", "lfoot"]
    np.testing.assert_allclose(s.ends[1][1], [0, 0, -7 * UNIT], atol=1e-12)
    femur = s.source.channels[3]
    assert femur.order == ("rx", "rz")
    np.testing.assert_allclose(np.degrees(femur.limits), [[-160, 20], [-70, 70]])
    np.testing.assert_allclose(np.degrees(femur.axis or 0), [0, 0, 20])
    assert clip.fps == 120.0
    assert "AMC files state no frame rate: 120 frames per second taken" in s.source.notes
    assert read_clip(tmp_path / "7_01.amc", fps=60).fps == 60.0


def test_pose_by_hand(tmp_path: Path) -> None:
    clip = read_clip(pair(tmp_path))
    t = 3
    # SciPy's lower-case "xyz" turns about fixed axes, x first: Rz Ry Rx.
    root = Rotation.from_euler("xyz", [3.0 * t, 5.0, -2.0 * t], degrees=True)
    c = Rotation.from_euler("xyz", [0, 0, 20], degrees=True)
    dof = Rotation.from_euler("xz", [-5.0 * t, 10.0], degrees=True)
    femur = root * c * dof * c.inv()
    ankle = np.array([0.1 * t, 15.0, 0.2 * t]) + femur.apply([4.8, -6.4, 0])
    x, y, z = ankle * UNIT
    np.testing.assert_allclose(clip.positions()[t, 4], [x, -z, y], atol=1e-9)


def test_radians_and_three_values_everywhere(tmp_path: Path) -> None:
    put(tmp_path, "7.asf", ASF)
    lines = []
    for line in amc_text().splitlines():
        words = line.split()
        if words[0] == "root":
            words[4:] = [f"{np.radians(float(w)):.9f}" for w in words[4:]]
        elif words[0] == "lfemur":
            words[1:] = [f"{np.radians(float(words[1])):.9f}", "0", f"{np.radians(float(words[2])):.9f}"]
        elif len(words) > 1 and words[0][0] not in "#:":
            words[1:] = [f"{np.radians(float(w)):.9f}" for w in words[1:]]
            words += ["0"] * (4 - len(words))
        lines.append(" ".join(words))
    text = "\n".join(lines).replace(":DEGREES", ":RADIANS\n:FORCE-ALL-JOINTS-BE-3DOF")
    other = read_clip(put(tmp_path, "7_02.amc", text))
    np.testing.assert_allclose(other.positions(), read_clip(pair(tmp_path)).positions(), atol=1e-6)


def test_which_skeleton(tmp_path: Path) -> None:
    take = pair(tmp_path)
    put(tmp_path, "8.asf", ASF)
    assert read_clip(take).skeleton.source.extra == (("skeleton", str(tmp_path / "7.asf")),)
    put(tmp_path, "9-arts.asf", ASF)
    named = read_clip(put(tmp_path, "9_06-arts.amc", amc_text()))
    assert named.skeleton.source.extra[0][1].endswith("9-arts.asf")
    lost = put(tmp_path, "5_01.amc", amc_text())
    with pytest.raises(PoiseError) as error:
        read_clip(lost)
    assert str(error.value) == (
        f"{lost}: no skeleton is named for subject '5', and several lie beside it: 7.asf, 8.asf, "
        "9-arts.asf. Name its skeleton with --skeleton FILE"
    )
    assert read_clip(lost, skeleton=tmp_path / "8.asf").frames == 6
    alone = tmp_path / "alone"
    alone.mkdir()
    put(alone, "x.asf", ASF)
    clip = read_clip(put(alone, "5_01.amc", amc_text()))
    assert "The skeleton x.asf was taken, the only one in the folder" in clip.skeleton.source.notes


def test_to_bvh_and_back(tmp_path: Path) -> None:
    clip = read_clip(pair(tmp_path))
    write_clip(clip, tmp_path / "a.bvh")
    back = read_clip(tmp_path / "a.bvh")
    assert back.skeleton.names == clip.skeleton.names
    assert np.abs(back.positions() - clip.positions()).max() < 1e-6


@pytest.mark.parametrize("name", ["02/02_01", "02/02_05", "11/11_01", "usc/135_06-martialArts"])
def test_real_takes_to_bvh_and_back(data_dir: Path, tmp_path: Path, name: str) -> None:
    clip = trim(read_clip(data_dir / f"cmu_amc/{name}.amc"), 0, 300)
    write_clip(clip, tmp_path / "a.bvh")
    back = read_clip(tmp_path / "a.bvh")
    assert np.abs(back.positions() - clip.positions()).max() < 1e-3
    assert back.fps == pytest.approx(120.0, rel=1e-9)


SHARED = {
    "root": "Hips",
    "lfemur": "LeftUpLeg",
    "ltibia": "LeftLeg",
    "lfoot": "LeftFoot",
    "ltoes": "LeftToeBase",
    "rfemur": "RightUpLeg",
    "rtibia": "RightLeg",
    "rfoot": "RightFoot",
    "rtoes": "RightToeBase",
    "upperback": "Spine",
    "thorax": "Spine1",
    "lowerneck": "Neck",
    "upperneck": "Neck1",
    "head": "Head",
    "lhumerus": "LeftArm",
    "lradius": "LeftForeArm",
    "lwrist": "LeftHand",
    "rhumerus": "RightArm",
    "rradius": "RightForeArm",
    "rwrist": "RightHand",
}


def test_one_take_in_two_formats(data_dir: Path) -> None:
    amc = read_clip(data_dir / "cmu_amc/01/01_01.amc")
    bvh = read_clip(data_dir / "cmu_bvh/fairmotion/01_01.bvh")
    # The BVH's extra frame is the rest pose before the motion, which the reader drops.
    assert amc.frames == bvh.frames == 2751
    # The BVH's own hierarchy leaves out the thorax bone (116.5 mm); without it here too, all
    # shared joints agree.
    offsets = amc.skeleton.offsets.copy()
    thorax = amc.skeleton.index("thorax")
    children = list(amc.skeleton.children(thorax))
    assert np.linalg.norm(offsets[children[0]]) == pytest.approx(0.11655, abs=1e-4)
    offsets[children] = 0.0
    pos, _ = forward_kinematics(amc.skeleton.parents, offsets, *amc.arrays())
    a = pos[:, [amc.skeleton.index(n) for n in SHARED]]
    b = bvh.positions()[:, [bvh.skeleton.index(n) for n in SHARED.values()]]
    assert np.linalg.norm(a - b, axis=-1).max() < 0.1e-3


LIMBS = {
    n: n for n in ("ltibia", "lfoot", "ltoes", "rtibia", "rfoot", "rtoes", "head", "lradius", "rradius")
}


def test_one_take_in_two_skeletons(data_dir: Path) -> None:
    """The karate take, fitted by two different skeletons (femur 40 against 44 cm, upper arm 31
    against 26 cm): rate, unit and up axis agree, joints to a few centimetres."""
    amc = read_clip(data_dir / "cmu_amc/usc/135_06-martialArts.amc")
    bvh = read_clip(data_dir / "cmu_bvh/ad/heiansyodan.bvh")
    assert amc.frames == bvh.frames
    a = amc.positions()[:, [amc.skeleton.index(n) for n in LIMBS]].reshape(-1, 3)
    b = bvh.positions()[:, [bvh.skeleton.index(n) for n in LIMBS]].reshape(-1, 3)
    scale, turn, shift = _similarity(a, b)
    # One turn about the vertical and nothing else: the unit (inches) and both verticals are right.
    assert scale == pytest.approx(1.0, abs=0.02)
    assert turn[2, 2] > 0.9999
    error = np.linalg.norm(scale * a @ turn.T + shift - b, axis=-1)
    assert error.mean() < 0.05


def _similarity(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation and shift that bring `a` to `b` with least squares (Umeyama 1991)."""
    ma, mb = a.mean(0), b.mean(0)
    u, s, vt = np.linalg.svd((b - mb).T @ (a - ma))
    sign = np.array([1, 1, np.linalg.det(u @ vt)])
    turn = (u * sign) @ vt
    scale = float((s * sign).sum() / ((a - ma) ** 2).sum())
    return scale, turn, mb - scale * turn @ ma


def test_person_of_the_cmu_library(data_dir: Path) -> None:
    clip: Clip = read_clip(data_dir / "cmu_amc/02/02_01.amc")
    facts = describe(clip)
    assert facts["unit_m"] == pytest.approx(UNIT) and facts["up_axis"] == "Y"
    assert 1.5 < facts["height_m"] < 1.9
    # Feet near the floor, hips near a metre above it.
    assert abs(clip.positions()[..., 2].min()) < 0.05
    assert 0.85 < np.median(clip.root_pos[:, 2]) < 1.1


def test_malformed_take_names_the_joint(data_dir: Path) -> None:
    path = data_dir / "other/malformed/135_06-martialArts-lq-N40.amc"
    with pytest.raises(PoiseError) as error:
        read_clip(path, skeleton=data_dir / "cmu_amc/usc/135-martialArts.asf")
    assert str(error.value) == (
        f"{path}, line 55: joint 'lfingers' at frame 2 has the unusable value nan"
    )
