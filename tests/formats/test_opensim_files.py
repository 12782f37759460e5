"""OpenSim coordinates: against what the words mean, real keypoints and feet that must stand still."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from handmade_motion_files import put
from handmade_numpy_files import save_npz

from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from poise.motion import Clip
from refusals import refused

PELVIS = ("pelvis_tilt", "pelvis_list", "pelvis_rotation", "pelvis_tx", "pelvis_ty", "pelvis_tz")
LEGS = ("hip_flexion_r", "hip_flexion_l", "knee_angle_r", "knee_angle_l")
HEADER = "Coordinates\nversion=1\nnRows={n}\nnColumns=3\ninDegrees=yes\n\nendheader\n"


def mot(frames: int = 5, **turns: float) -> str:
    """A table in degrees of a body that stands; `turns` are constant coordinates."""
    names = ["time", *dict.fromkeys((*PELVIS, *LEGS, *turns))]
    rows = []
    for t in range(frames):
        values = {"time": 0.01 * t, "pelvis_tx": 0.1 * t, "pelvis_ty": 0.94, **turns}
        rows.append("\t".join(f"{values.get(n, 0.0):.8f}" for n in names))
    return HEADER.format(n=frames) + "\t".join(names) + "\n" + "\n".join(rows) + "\n"


def joint(clip: Clip, name: str, frame: int = 0) -> np.ndarray:
    return clip.positions()[frame, clip.skeleton.index(name)]


def bone(clip: Clip, a: str, b: str) -> np.ndarray:
    return joint(clip, b) - joint(clip, a)


def test_standing_and_walking_ahead(tmp_path: Path) -> None:
    clip = read_clip(put(tmp_path, "a.mot", mot()))
    assert clip.fps == pytest.approx(100) and clip.frames == 5 and len(clip.skeleton) == 17
    np.testing.assert_allclose(clip.root_pos[3], [0.3, 0, 0.94], atol=1e-7)
    # X ahead, Z up: right is -Y, and the toes point ahead on the floor.
    assert joint(clip, "hip_r")[1] < 0 < joint(clip, "hip_l")[1]
    assert bone(clip, "ankle_r", "toe_r")[0] > 0.1 and abs(joint(clip, "toe_r")[2]) < 0.05
    assert joint(clip, "head")[2] > 1.45


@pytest.mark.parametrize("side", ["r", "l"])
def test_words_mean_what_they_say(tmp_path: Path, side: str) -> None:
    out = -1.0 if side == "r" else 1.0
    words = {
        f"hip_flexion_{side}": (f"hip_{side}", f"knee_{side}", [np.sin(0.5), 0, -np.cos(0.5)]),
        f"hip_adduction_{side}": (f"hip_{side}", f"knee_{side}", [0, -out * np.sin(0.5), -np.cos(0.5)]),
        f"arm_flex_{side}": (f"shoulder_{side}", f"elbow_{side}", [np.sin(0.5), 0, -np.cos(0.5)]),
        f"sh_elev_{side}": (f"shoulder_{side}", f"elbow_{side}", [0, out * np.sin(0.5), -np.cos(0.5)]),
    }
    for word, (a, b, wanted) in words.items():
        path = put(tmp_path, "a.mot", mot(**{word: np.degrees(0.5)}))
        straight = read_clip(put(tmp_path, "b.mot", mot()))
        bent = read_clip(path)
        down = bone(straight, a, b) / np.linalg.norm(bone(straight, a, b))
        way = bone(bent, a, b) / np.linalg.norm(bone(bent, a, b))
        # The default upper arm points down but for two degrees.
        np.testing.assert_allclose(way - down, np.array(wanted) - [0, 0, -1], atol=0.05, err_msg=word)
    for sign in (1, -1):
        clip = read_clip(put(tmp_path, "a.mot", mot(**{f"knee_angle_{side}": 40.0 * sign})))
        assert bone(clip, f"knee_{side}", f"ankle_{side}")[0] < -0.2
    clip = read_clip(put(tmp_path, "a.mot", mot(**{f"ankle_angle_{side}": 20.0})))
    ankle, toe = f"ankle_{side}", f"toe_{side}"
    assert bone(clip, ankle, toe)[2] > bone(straight, ankle, toe)[2] + 0.03
    clip = read_clip(put(tmp_path, "a.mot", mot(**{f"elbow_flex_{side}": 90.0})))
    assert bone(clip, f"elbow_{side}", f"wrist_{side}")[0] > 0.2


def test_round_trip(tmp_path: Path) -> None:
    clip = read_clip(put(tmp_path, "a.mot", mot(hip_flexion_r=20.0, arm_add_l=-30.0)))
    for name in ("b.npz", "b.csv"):
        write_clip(clip, tmp_path / name)
        back = read_clip(tmp_path / name)
        np.testing.assert_array_equal(back.rot, clip.rot)
        assert back.skeleton == clip.skeleton


def test_mot_refusals(tmp_path: Path) -> None:
    def refusal(text: str) -> str:
        path = put(tmp_path, "a.mot", text)
        with pytest.raises(PoiseError) as error:
            read_clip(path)
        return str(error.value).removeprefix(str(path))

    good = mot()
    lines = good.splitlines()
    assert refusal("\n".join([*lines[:9], "1 2 3", *lines[9:]])) == (
        ", line 10: the row has 3 values; there are 11 columns"
    )
    assert refusal("\n".join([*lines[:10], *lines[11:]])) == (
        ": its times are not evenly spaced. Resample it in OpenSim"
    )
    assert refusal(good.replace("0.94000000", "nan", 2)) == (
        ": coordinate 'pelvis_ty' at frame 0 is nan, not a usable number"
    )
    assert refusal(good.replace("pelvis_ty", "pelvis_t_")).startswith(
        ": this OpenSim motion lacks pelvis_ty. Did you mean 'pelvis_tz'?"
    )
    assert refusal("\n".join(lines[:9]) + "\n") == ": the clip has 1 frame; motion needs at least 2"


def loco(frames: int = 40) -> dict[str, Any]:
    t = np.arange(frames) / 500
    data = {f"q_{n}": np.zeros(frames) for n in (*PELVIS, *LEGS)}
    data["q_hip_flexion_r"], data["dq_hip_flexion_r"] = np.sin(3 * t), 3 * np.cos(3 * t)
    data["q_knee_angle_l"] = np.full(frames, 0.3)
    return data


def test_loco_arrays(tmp_path: Path) -> None:
    clip = read_clip(save_npz(tmp_path / "a.npz", loco()))
    assert clip.fps == 500.0 and clip.skeleton.source.format == "opensim"
    np.testing.assert_allclose(clip.root_pos[:, 2], 0.94)
    data = {k: v for k, v in loco().items() if not k.startswith("dq_")}
    with refused("rate-missing", says="--fps"):
        read_clip(save_npz(tmp_path / "a.npz", data))
    assert read_clip(tmp_path / "a.npz", fps=100).fps == 100.0
    with refused("length-differs"):
        read_clip(save_npz(tmp_path / "a.npz", {**loco(), "q_arm_flex_r": np.zeros(3)}))


def test_feet_stand_still_while_they_stand(data_dir: Path) -> None:
    clip = read_clip(data_dir / "other/loco_mujoco_npz/02-constspeed_full_humanoid.npz")
    assert clip.fps == 500.0 and clip.frames == 500
    for name, stance in (("ankle_r", slice(60, 260)), ("ankle_l", slice(345, 470))):
        path = clip.positions()[:, clip.skeleton.index(name)]
        speed = np.abs(np.gradient(path, axis=0)[stance] * clip.fps).mean(0)
        # The body walks at 1.37 m/s meanwhile.
        assert speed.max() < 0.1, (name, speed)


def trc(path: Path) -> dict[str, np.ndarray]:
    """Marker paths `(T, 3)` m, Z up, of a Pose2Sim table."""
    lines = path.read_text().splitlines()
    names = [n for n in lines[3].split("\t")[2:] if n.strip()]
    rows = [[float(x) for x in row.split("\t")[2:] if x.strip()] for row in lines[5:] if row.strip()]
    x, y, z = np.moveaxis(np.array(rows).reshape(len(rows), len(names), 3), -1, 0)
    return dict(zip(names, np.moveaxis(np.stack((x, -z, y), -1), 1, 0), strict=True))


def test_bones_point_as_the_keypoints_of_the_same_take(data_dir: Path) -> None:
    folder = data_dir / "noisy/pose2sim/single"
    clip = read_clip(folder / "S00_P00_T01_BalancingTrial_filt_butterworth_0-100_LSTM.mot")
    seen = trc(folder / "S00_P00_T01_BalancingTrial_0-100_filt_butterworth_LSTM.trc")
    places = clip.positions()
    limits = {"hip-knee": 9.0, "knee-ankle": 6.0, "shoulder-elbow": 20.0, "elbow-wrist": 20.0}
    for pair, limit in limits.items():
        a, b = pair.split("-")
        for side in "rl":
            own = places[:, clip.skeleton.index(f"{b}_{side}")]
            own = own - places[:, clip.skeleton.index(f"{a}_{side}")]
            mark = side.upper()
            real = seen[mark + b.capitalize()] - seen[mark + a.capitalize()]
            dots = (own * real).sum(-1)
            dots /= np.linalg.norm(own, axis=-1) * np.linalg.norm(real, axis=-1)
            assert np.degrees(np.arccos(dots.clip(-1, 1))).mean() < limit, (pair, side)
    for name in ("RHip", "LHip", "RAnkle", "LAnkle"):
        own = places[:, clip.skeleton.index(f"{name[1:].lower()}_{name[0].lower()}")]
        assert np.linalg.norm(own - seen[name], axis=-1).mean() < 0.08
