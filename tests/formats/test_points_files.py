"""Keypoint files: TRC, C3D, CSV, arrays; what they hold, what is guessed, and every refusal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from handmade_numpy_files import amass, save_npz

from poise.formats import read_clip
from poise.formats.c3d import c3d_points
from poise.formats.point_arrays import HUMANML3D, array_points, mdm_points
from poise.formats.point_fit import FitConfig, fit_clip, fit_distances
from poise.formats.point_raw import assemble_points
from poise.formats.point_tables import csv_points, trc_points
from poise.formats.raw import ReadOptions
from poise.motion import Clip
from refusals import refused

# A standing person in a file's Y-up axes, facing +Z, left at +X, m.
PERSON = {
    "RHip": (-0.1, 0.9, 0), "LHip": (0.1, 0.9, 0), "RKnee": (-0.1, 0.5, 0.02), "LKnee": (0.1, 0.5, 0.02),
    "RAnkle": (-0.1, 0.1, 0), "LAnkle": (0.1, 0.1, 0), "RBigToe": (-0.1, 0.02, 0.18),
    "LBigToe": (0.1, 0.02, 0.18), "RShoulder": (-0.18, 1.4, 0), "LShoulder": (0.18, 1.4, 0),
    "RElbow": (-0.2, 1.1, -0.01), "LElbow": (0.2, 1.1, -0.01), "RWrist": (-0.2, 0.86, 0.06),
    "LWrist": (0.2, 0.86, 0.06), "Neck": (0, 1.45, 0), "Head": (0, 1.7, 0.02), "Nose": (0, 1.6, 0.1),
}  # fmt: skip
NAMES = tuple(PERSON)
POINTS = np.array(list(PERSON.values()))
POSE2SIM = "noisy/pose2sim/single/S00_P00_T01_BalancingTrial_0-100"


def walking(frames: int = 8) -> np.ndarray:
    """`(T, K, 3)`: the person moves ahead by 1 cm a frame."""
    return POINTS + np.arange(frames)[:, None, None] * np.array([0.001, 0.002, 0.01])


def trc_text(
    positions: np.ndarray | None = None,
    names: tuple[str, ...] = NAMES,
    rate: str = "30",
    unit: str = "m",
    frames: str | None = None,
    markers: str | None = None,
) -> str:
    positions = walking() if positions is None else positions
    lines = [
        "PathFileType\t4\t(X/Y/Z)\tx.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{frames or len(positions)}\t{markers or len(names)}\t{unit}\t{rate}\t0\t0",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"{a}{k + 1}" for k in range(len(names)) for a in "XYZ"),
    ]
    for t, row in enumerate(positions):
        cells = ["" if np.isnan(v) else f"{v:.6f}" for v in row.ravel()]
        lines.append("\t".join([str(t + 1), f"{t / 30:.6f}", *cells]))
    return "\n".join(lines) + "\n"


def saved(folder: Path, text: str, name: str = "x.trc") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def notes(clip: Clip) -> str:
    return " | ".join(clip.skeleton.source.notes)


def test_trc_by_hand(tmp_path: Path) -> None:
    positions = walking()
    positions[3, NAMES.index("RWrist"), 1] = np.nan
    raw = trc_points(saved(tmp_path, trc_text(positions * 1000, unit="mm")))
    assert (raw.names, raw.fps, raw.unit_m) == (NAMES, 30.0, 0.001)
    points = assemble_points(raw, ReadOptions())
    # Y up becomes Z up: (x, y, z) -> (x, -z, y).
    expected = np.stack((positions[..., 0], -positions[..., 2], positions[..., 1]), -1)
    expected[3, NAMES.index("RWrist")] = np.nan
    assert np.allclose(points.positions, expected, atol=1e-8, equal_nan=True)
    assert points.source.up_axis == "Y" and any("Y taken" in n for n in points.source.notes)


def test_a_trc_is_read_as_any_other_clip(tmp_path: Path) -> None:
    path = saved(tmp_path, trc_text(), "no_suffix_needed")
    clip = read_clip(path)
    assert (clip.frames, clip.fps, clip.skeleton.source.format) == (8, 30.0, "trc")
    assert clip.skeleton.source.path == str(path)
    assert clip.positions()[..., 2].min() > -0.02
    wrist = clip.positions()[:, clip.skeleton.index("RightHand")]
    assert np.allclose(wrist, walking()[:, NAMES.index("RWrist")][:, [0, 2, 1]] * [1, -1, 1], atol=2e-3)
    assert read_clip(path, fps=60).fps == 60
    assert "low-pass at 6 Hz" in notes(read_clip(path, smooth_hz=6.0))
    with refused("out-of-range", says="--smooth"):
        read_clip(path, smooth_hz=0.0)


def test_points_with_y_down_are_turned_over(tmp_path: Path) -> None:
    clip = read_clip(saved(tmp_path, trc_text(walking() * [1.0, -1.0, -1.0])))
    assert "turned over" in notes(clip)
    at = clip.positions().mean(0)
    assert at[clip.skeleton.index("Head"), 2] > at[clip.skeleton.index("LeftFoot"), 2] + 1.0
    # Left stays left of the way the toes point: up x forward is left.
    toe = at[clip.skeleton.index("LeftToeBase")] - at[clip.skeleton.index("LeftFoot")]
    left = at[clip.skeleton.index("LeftUpLeg")] - at[clip.skeleton.index("RightUpLeg")]
    assert np.cross([0, 0, 1.0], toe) @ left > 0


def test_an_unknown_unit_is_guessed_from_the_persons_height(tmp_path: Path) -> None:
    clip = read_clip(saved(tmp_path, trc_text(walking() * 100, unit="furlong")))
    assert clip.skeleton.source.unit_m == 0.01
    assert "'furlong' is not known" in notes(clip) and "centimetres taken" in notes(clip)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda t: t.replace("\t0.860000\t", "\tabc\t", 1),
            ("not-a-number", ("line 6, column 40 (RWrist Y)", "abc")),
        ),
        (lambda t: t.replace("\t0.860000\t", "\t1_0\t", 1), ("not-a-number", "1_0")),
        (lambda t: t.replace("\t0.860000\t", "\tinf\t", 1), ("number-unusable", "inf")),
        (lambda t: t.replace("0.860000\t", "", 1), ("row-width", ("line 6", "52", "53"))),
        (lambda t: "\n".join(t.splitlines()[:5]), ("no-frames",)),
        (lambda t: "\n".join(t.splitlines()[:2]), ("file-cut-off",)),
        (lambda t: "\n".join(t.splitlines()[:6]), ("clip-too-short", "1")),
        (lambda t: t.replace("DataRate", "Rate", 1), ("rate-missing",)),
        (lambda t: t.replace("LHip", "RHip"), ("name-repeated", "RHip")),
        (lambda t: t.replace("RAnkle", "Foo"), ("keypoint-missing", "right ankle")),
        (lambda t: t.replace("\t17\tm\t", "\t18\tm\t"), ("count-differs", ("18", "17"))),
        (lambda t: t.replace("\tm\t", "\tmm\t", 1), ("unit-implausible", "mm")),
    ],
)
def test_broken_trc_files_are_refused_in_one_sentence(
    tmp_path: Path, change: Any, message: tuple
) -> None:
    path = saved(tmp_path, change(trc_text()))
    with refused(*message) as caught:
        read_clip(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_flat_points_and_empty_ones_are_refused(tmp_path: Path) -> None:
    with refused("flat-keypoints", says="Z"):
        read_clip(saved(tmp_path, trc_text(walking() * [1.0, 1.0, 0.0])))
    with refused("keypoints-unseen"):
        read_clip(saved(tmp_path, trc_text(walking() * np.nan)))


def test_a_header_that_miscounts_frames_is_told(tmp_path: Path) -> None:
    assert "states 9 frames, the file has 8" in notes(read_clip(saved(tmp_path, trc_text(frames="9"))))


def test_a_rate_of_zero_is_measured_on_the_times(tmp_path: Path) -> None:
    clip = read_clip(saved(tmp_path, trc_text(rate="0")))
    assert clip.fps == pytest.approx(30, rel=1e-3) and "DataRate is 0" in notes(clip)


def test_trailing_blanks_that_an_editor_trimmed_are_missing_points(tmp_path: Path) -> None:
    lines = trc_text().splitlines()
    lines[6] = "\t".join(lines[6].split("\t")[:-6])
    raw = trc_points(saved(tmp_path, "\n".join(lines)))
    assert np.isnan(raw.positions[1, -2:]).all() and not np.isnan(raw.positions[1, :-2]).any()


def csv_text(positions: np.ndarray, header: str = "", time: bool = True) -> str:
    columns = ["time"] * time + [f"{n}_{a}" for n in NAMES for a in "xyz"]
    rows = [
        ",".join([f"{t / 50:.4f}"] * time + ["" if np.isnan(v) else f"{v:.6f}" for v in row.ravel()])
        for t, row in enumerate(positions)
    ]
    return "\n".join([*([header] if header else []), ",".join(columns), *rows]) + "\n"


def test_csv_by_hand(tmp_path: Path) -> None:
    path = saved(tmp_path, csv_text(walking()), "x.csv")
    raw = csv_points(path)
    assert raw.names == NAMES and raw.fps == pytest.approx(50) and raw.unit_m is None
    assert np.allclose(raw.positions, walking(), atol=1e-6)
    assert read_clip(path).skeleton.source.format == "csv"
    stated = saved(
        tmp_path, csv_text(walking() * 100, "# unit = cm, up = Y, fps = 25", time=False), "y.csv"
    )
    raw = csv_points(stated)
    assert (raw.unit_m, raw.up_axis, raw.fps) == (0.01, "Y", 25.0)
    assert read_clip(stated).fps == 25.0


def test_a_table_below_a_long_licence_is_read(tmp_path: Path) -> None:
    licence = "".join(f"# line {k} of a long licence text\n" for k in range(400))
    clip = read_clip(saved(tmp_path, licence + csv_text(walking()), "x.csv"))
    assert clip.frames == 8 and clip.skeleton.source.format == "csv"
    with refused("wrong-format"):
        read_clip(saved(tmp_path, licence, "x.csv"))


def test_csv_confidence_of_zero_is_a_missing_point(tmp_path: Path) -> None:
    lines = csv_text(walking()).splitlines()
    lines = [f"{lines[0]},Nose_confidence"] + [f"{row},{int(t != 2)}" for t, row in enumerate(lines[1:])]
    points = assemble_points(csv_points(saved(tmp_path, "\n".join(lines), "x.csv")), ReadOptions())
    assert np.flatnonzero(points.missing[:, NAMES.index("Nose")]).tolist() == [2]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.replace("Nose_z", "Nose_q"), ("column-missing", ("Nose", "z"))),
        (
            lambda t: t.replace("0.860000", "nope", 1),
            ("not-a-number", ("line 2, column 39 (RWrist_y)", "nope")),
        ),
        (lambda t: t.replace(",0.860000", "", 1), ("row-width", ("51", "52"))),
        (lambda t: t.splitlines()[0], ("no-frames",)),
        (lambda t: t.replace("0.0800,", "0.0800e3,"), ("times-uneven",)),
        (lambda t: t.replace("time", "frame"), ("rate-missing", "--fps")),
        (lambda t: "# unit = ells\n" + t, ("unit-unknown", "ells")),
    ],
)
def test_broken_csv_files_are_refused_in_one_sentence(
    tmp_path: Path, change: Any, message: tuple
) -> None:
    path = saved(tmp_path, change(csv_text(walking())), "x.csv")
    with refused(*message) as caught:
        read_clip(path)
    assert "\n" not in str(caught.value)


def test_csv_in_2d_is_refused_with_what_to_do(tmp_path: Path) -> None:
    text = "time," + ",".join(f"{n}_x,{n}_y" for n in NAMES) + "\n0," + ",".join("1" for _ in range(34))
    with refused("flat-keypoints"):
        read_clip(saved(tmp_path, text, "x.csv"))


def test_openpose_is_refused_with_what_to_do(tmp_path: Path) -> None:
    frame = '{"version":1.3,"people":[{"person_id":[-1],"pose_keypoints_2d":[1,2,0.5]}]}'
    folder = tmp_path / "cam01_json"
    folder.mkdir()
    path = saved(folder, frame, "cam01.0000.json")
    for given in (path, folder):
        with refused("flat-keypoints"):
            read_clip(given)


def test_keypoint_arrays(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    np.savez(path, positions=walking(), names=np.array(NAMES), fps=30.0, unit_m=1.0, up_axis="Y")
    clip = read_clip(path)
    assert (clip.frames, clip.fps, clip.skeleton.source.format) == (8, 30.0, "keypoints-npz")
    for change, message in (
        ({"positions": walking()[..., :2]}, ("flat-keypoints",)),
        ({"names": np.array(NAMES[:-1])}, ("count-differs", ("16", "17"))),
        ({"fps": np.array(0.0)}, ("rate-out-of-range",)),
        ({"up_axis": np.array("W")}, ("unknown-axis", "W")),
        ({"positions": np.array(["a"])}, ("wrong-type",)),
    ):
        data = {"positions": walking(), "names": np.array(NAMES), "fps": np.array(30.0), **change}
        with refused(*message):
            array_points(data, path)
    with refused("rate-missing"):
        array_points({"positions": walking(), "names": np.array(NAMES)}, path)


def test_results_of_the_motion_diffusion_model(data_dir: Path) -> None:
    path = data_dir / "other/text_to_motion/mdm_results_pred.npy"
    with refused("pickle-refused", says="--allow-pickle"):
        read_clip(path)
    clip = read_clip(path, allow_pickle=True)
    assert (clip.fps, clip.frames, clip.skeleton.source.up_axis) == (20.0, 192, "Y")
    assert "holds 30 motions" in notes(clip) and "A person throws" in notes(clip)
    assert "LeftToeBase" in clip.skeleton.names and len(HUMANML3D) == 22
    assert "number 7 was read" in notes(read_clip(path, allow_pickle=True, take="7"))
    with refused("option-malformed", says="last"):
        read_clip(path, allow_pickle=True, take="last")
    data = {"motion": np.zeros((2, 22, 3, 9)), "lengths": np.array([9, 12])}
    assert mdm_points(data, path).positions.shape == (9, 22, 3)
    with refused("length-differs", says=("12", "9")):
        mdm_points(data, path, ReadOptions(take="1"))
    with refused("unknown-take", says="2"):
        mdm_points(data, path, ReadOptions(take="2"))


def test_joints_with_their_rate_are_read_as_joints_alone(tmp_path: Path) -> None:
    points = read_clip(save_npz(tmp_path / "smpl.npz", amass(66))).positions()
    clip = read_clip(save_npz(tmp_path / "a.npz", {"joints": points, "fps": np.array(30.0)}))
    np.save(tmp_path / "a.npy", points)
    alone = read_clip(tmp_path / "a.npy", fps=30.0)
    assert clip.fps == 30.0 and np.array_equal(clip.rot, alone.rot)
    assert clip.skeleton.source.format == "joints"
    for told in (clip, alone):
        assert "states no unit: metres taken" in dict(told.skeleton.source.evidence)["unit"]
    stated = read_clip(tmp_path / "a.npy", fps=30.0, unit_m=1.0)
    assert dict(stated.skeleton.source.evidence)["unit"] == "Stated with --unit"
    bad = save_npz(tmp_path / "b.npz", {"joints": points[:, :9], "fps": np.array(30.0)})
    with refused("wrong-shape"):
        read_clip(bad)


def test_joints_go_by_their_names_where_they_have_some(tmp_path: Path) -> None:
    points = read_clip(save_npz(tmp_path / "smpl.npz", amass(66))).positions()
    names, turned = np.array(HUMANML3D), np.random.default_rng(0).permutation(22)
    sound = read_clip(save_npz(tmp_path / "a.npz", {"joints": points, "fps": np.array(30.0)}))
    for key in ("names", "joint_names"):
        data = {"joints": points[:, turned], "fps": np.array(30.0), key: names[turned]}
        clip = read_clip(save_npz(tmp_path / f"{key}.npz", data))
        assert clip.skeleton.source.format == "joints"
        heads = (c.positions()[:, c.skeleton.index("Head")] for c in (clip, sound))
        assert np.abs(next(heads) - next(heads)).max() < 0.02
    for wrong, said in (
        (names[:21], ("count-differs", ("21", "22"))),
        (np.array([f"j{k}" for k in range(22)]), ("keypoint-missing", "left hip")),
    ):
        data = {"joints": points, "fps": np.array(30.0), "names": wrong}
        with refused(*said):
            read_clip(save_npz(tmp_path / "b.npz", data))


def write_c3d(path: Path, positions: np.ndarray, names: tuple[str, ...], unit: str = "mm") -> None:
    ezc3d = pytest.importorskip("ezc3d")
    file = ezc3d.c3d()
    point = file["parameters"]["POINT"]
    point["RATE"]["value"], point["UNITS"]["value"] = [100], [unit]
    point["LABELS"]["value"] = names
    data = np.ones((4, len(names), len(positions)))
    data[:3] = positions.transpose(2, 1, 0)
    file["data"]["points"] = data
    file.write(str(path))


def test_c3d_markers(tmp_path: Path) -> None:
    path = tmp_path / "x.c3d"
    positions = walking() * 1000
    positions[4, 5] = np.nan
    extra = np.concatenate((positions, positions[:, :1] + 5), 1)
    write_c3d(path, extra, (*(f"Anna:{n}" for n in NAMES), "*7"))
    raw = c3d_points(path)
    assert raw.names == tuple(f"Anna:{n}" for n in NAMES)
    assert (raw.fps, raw.unit_m) == (100.0, 0.001)
    assert np.allclose(raw.positions, positions, atol=1e-3, equal_nan=True)
    assert read_clip(path).skeleton.source.format == "c3d"


def test_broken_c3d_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.c3d"
    write_c3d(path, walking() * 1000, NAMES)
    whole = path.read_bytes()
    path.write_bytes(whole[:300])
    with refused("wrong-format"):
        read_clip(path)
    path.write_bytes(whole[:600])
    with refused("file-cut-off"):
        read_clip(path)
    path.write_bytes(whole[:2] + b"\xff\x07" + whole[4:])
    with refused("file-cut-off"):
        read_clip(path)


def test_surface_markers_become_joint_centres(data_dir: Path) -> None:
    raw = trc_points(data_dir / f"{POSE2SIM}_filt_butterworth_LSTM.trc")
    points = assemble_points(raw, ReadOptions())
    keep = [k for k, n in enumerate(points.names) if n.endswith("_study")]
    markers = points.replaced(
        names=tuple(points.names[k] for k in keep), positions=points.positions[:, keep]
    )
    whole = fit_clip(markers)
    assert np.mean([d.mean() for d in fit_distances(markers, whole).values()]) < 0.015
    # The same with the outer markers alone, under the names of Plug-in Gait.
    pairs = {"ASIS": "ASI", "PSIS": "PSI", "knee": "KNE", "ankle": "ANK", "toe": "TOE", "calc": "HEE",
             "shoulder": "SHO", "lelbow": "ELB", "lwrist": "WRA", "mwrist": "WRB"}  # fmt: skip
    gait = {f"{s}{'.' if 'SIS' in old else '_'}{old}_study": f"{s.upper()}{new}"
            for old, new in pairs.items() for s in "rL"}  # fmt: skip
    at = [k for k, n in enumerate(points.names) if n in gait]
    assert len(at) == len(gait)
    few = points.replaced(
        names=tuple(gait[points.names[k]] for k in at), positions=points.positions[:, at]
    )
    outer = fit_clip(few)
    for text in ("Harrington", "outer markers show the left knee", "below the shoulder markers"):
        assert text in notes(outer)
    for joint, limit in (
        ("LeftLeg", 0.025),
        ("RightFoot", 0.03),
        ("LeftForeArm", 0.03),
        ("LeftUpLeg", 0.06),
    ):
        a, b = (c.positions()[:, c.skeleton.index(joint)] for c in (whole, outer))
        assert np.linalg.norm(a - b, axis=-1).mean() < limit, joint


@pytest.mark.parametrize(
    ("tail", "limit"), [("", 0.022), ("_filt_butterworth", 0.018), ("_filt_butterworth_LSTM", 0.018)]
)
def test_pose2sim_keypoints_are_followed_within_centimetres(
    data_dir: Path, tail: str, limit: float
) -> None:
    points = assemble_points(trc_points(data_dir / f"{POSE2SIM}{tail}.trc"), ReadOptions())
    clip = fit_clip(points, FitConfig())
    assert (clip.frames, clip.fps, points.source.unit_m, points.source.up_axis) == (100, 60.0, 1.0, "Y")
    assert np.mean([np.nanmean(d) for d in fit_distances(points, clip).values()]) < limit


@pytest.mark.parametrize("suffix", [".trc", ".csv", ".npz", ".c3d"])
@pytest.mark.parametrize("gone", [np.nan, 0.0])
def test_a_keypoint_that_is_missing_throughout_is_named_or_left_out(
    tmp_path: Path, suffix: str, gone: float
) -> None:
    def read(*lost: str) -> Clip:
        positions = walking(40)
        positions[:, [NAMES.index(name) for name in lost]] = gone
        path = tmp_path / f"x{suffix}"
        if suffix == ".trc":
            path.write_text(trc_text(positions))
        elif suffix == ".c3d":
            write_c3d(path, positions * 1000, NAMES)
        elif suffix == ".npz":
            np.savez(path, positions=positions, names=np.array(NAMES), fps=30.0, unit_m=1.0, up_axis="Y")
        else:
            cells = [["" if np.isnan(v) else f"{v:.6f}" for v in row.ravel()] for row in positions]
            head = ",".join(f"{n}_{a}" for n in NAMES for a in "xyz")
            rows = "\n".join(",".join(row) for row in cells)
            path.write_text(f"# unit = m, up = Y, fps = 30\n{head}\n{rows}\n")
        return read_clip(path)

    whole = read()
    for lost, said in (
        (
            ("LKnee",),
            ("LKnee", "left knee"),
        ),
        (
            ("RHip", "Nose"),
            ("RHip", "right hip"),
        ),
        (
            ("LWrist", "LElbow"),
            ("LElbow", "LWrist", "left elbow, left wrist"),
        ),
    ):
        with refused("keypoints-unseen", says=said):
            read(*lost)
    few = read("Nose", "LBigToe")
    assert "Missing in every frame and left out: LBigToe, Nose" in notes(few)
    # Arms and legs are where they were.
    for joint in ("LeftHand", "RightFoot", "LeftFoot"):
        a, b = (c.positions()[:, c.skeleton.index(joint)] for c in (whole, few))
        assert np.abs(a - b).max() < 2e-3, joint


def test_a_marker_that_is_missing_throughout_is_estimated_from_the_others(data_dir: Path) -> None:
    raw = trc_points(data_dir / f"{POSE2SIM}_filt_butterworth_LSTM.trc")
    points = assemble_points(raw, ReadOptions())
    keep = [k for k, n in enumerate(points.names) if n.endswith("_study")]
    names, positions = tuple(points.names[k] for k in keep), points.positions[:, keep]
    whole = fit_clip(points.replaced(names=names, positions=positions))

    def without(name: str) -> Clip:
        some = np.array(positions)
        some[:, names.index(name)] = np.nan
        return fit_clip(points.replaced(names=names, positions=some))

    made = without("L_mknee_study")
    assert "Missing in every frame and left out: L_mknee_study" in notes(made)
    assert "Only outer markers show the left knee" in notes(made)
    a, b = (c.positions()[:, c.skeleton.index("LeftLeg")] for c in (whole, made))
    assert np.linalg.norm(a - b, axis=-1).mean() < 0.025
    with refused("keypoints-unseen", says=("L_shoulder_study", "left shoulder")):
        without("L_shoulder_study")
