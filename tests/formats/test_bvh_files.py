"""BVH: hand-computed poses, dialects of position channels, writing and reading back."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from handmade_motion_files import BVH_HEADER, bvh_rows, bvh_text, put

from poise.errors import PoiseError
from poise.formats import WRITERS, read_clip, write_bvh, write_clip
from poise.motion import Clip, Skeleton, trim
from poise.motion.rotations import quat_angle, quat_conj, quat_mul
from refusals import refused

TRAVEL = """HIERARCHY
ROOT joint_Root
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Hips
  {
    OFFSET 4 91 -427
    CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
    JOINT Head
    {
      OFFSET 0 65 0
      CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
    }
    JOINT Foot
    {
      OFFSET 0 -85 0
      CHANNELS 3 Zrotation Xrotation Yrotation
    }
  }
}
"""


def same(a: Clip, b: Clip) -> tuple[float, float]:
    """Largest distance in mm and angle in degrees between two clips, joints matched by name."""
    at = [b.skeleton.index(n) for n in a.skeleton.names]
    distance = np.linalg.norm(a.positions() - b.positions()[:, at], axis=-1).max() * 1e3
    turn = quat_mul(quat_conj(a.rot), b.rot[:, at])
    return float(distance), float(np.rad2deg(quat_angle(turn).max()))


def test_rest_pose_stands_in_z_up(tmp_path: Path) -> None:
    rows = [" ".join(["3", "90", "7"] + ["0"] * 15)] * 3
    clip = read_clip(put(tmp_path, "a.bvh", bvh_text(rows)))
    # File (x, y, z) becomes (x, -z, y), centimetres become metres.
    np.testing.assert_allclose(clip.root_pos[0], [0.03, -0.07, 0.90])
    np.testing.assert_allclose(clip.positions()[0, 2], [0.03, -0.07, 1.55])
    np.testing.assert_allclose(clip.skeleton.ends[1][1], [0, -0.15, -0.05])
    np.testing.assert_allclose(clip.rot[0], [[1, 0, 0, 0]] * 5)
    assert clip.fps == pytest.approx(50.0) and clip.name == "a"
    source = clip.skeleton.source
    assert (source.format, source.unit_m, source.up_axis, source.frame_time) == ("bvh", 0.01, "Y", 0.02)


def test_rotation_order_is_the_channels_order(tmp_path: Path) -> None:
    # Head: Y 90 then X 90, intrinsic: R = Ry Rx takes file y to Ry(z) = x.
    row = " ".join(["0 90 0"] + ["0"] * 6 + ["90 90 0"] + ["0"] * 6)
    clip = read_clip(put(tmp_path, "a.bvh", bvh_text([row] * 3)))
    tip = np.array([[0.0, 0.0, 0.2]], dtype=float)  # file (0, 20, 0) cm
    from poise.motion.rotations import quat_rotate

    got = quat_rotate(clip.rot[:1, 2], tip)[0]
    np.testing.assert_allclose(got, [0.2, 0.0, 0.0], atol=1e-12)


def test_root_offset_is_not_added(tmp_path: Path) -> None:
    header = BVH_HEADER.replace("OFFSET 0 0 0", "OFFSET -287 92 338", 1)
    clip = read_clip(put(tmp_path, "a.bvh", bvh_text(header=header)))
    np.testing.assert_allclose(clip.root_pos[0], [0, 0, 0.9], atol=1e-12)
    assert any("OFFSET is not added" in n for n in clip.skeleton.source.notes)
    write_clip(clip, tmp_path / "b.bvh")
    assert "OFFSET -287.000000000 92.000000000 338.000000000" in (tmp_path / "b.bvh").read_text()


def test_travel_below_a_still_root(tmp_path: Path) -> None:
    rows = []
    for t in range(5):
        hips = [f"{10 * t} 90 {5 * t}", f"{30 + t} 0 0"]
        rows.append(" ".join(["0 0 0 0 0 0", *hips, "0 65 0 0 0 0", "0 0 0"]))
    path = put(tmp_path, "a.bvh", bvh_text(rows, header=TRAVEL))
    clip = read_clip(path)
    assert clip.skeleton.source.travel_joint == "Hips"
    hips = clip.positions()[:, 1]
    t = np.arange(5)
    np.testing.assert_allclose(hips, np.stack((0.1 * t, -0.05 * t, np.full(5, 0.9)), -1), atol=1e-12)
    # The head, 65 cm above the hips, leans to -x by 30 degrees and more.
    lean = np.radians(30 + t)
    head = hips + 0.65 * np.stack((-np.sin(lean), 0 * lean, np.cos(lean)), -1)
    np.testing.assert_allclose(clip.positions()[:, 2], head, atol=1e-12)
    write_clip(clip, tmp_path / "b.bvh")
    text = (tmp_path / "b.bvh").read_text()
    assert "OFFSET 4.000000000 91.000000000 -427.000000000" in text
    last = [float(x) for x in text.splitlines()[-1].split()]
    np.testing.assert_allclose(last, [float(x) for x in rows[-1].split()], atol=1e-6)
    assert max(same(clip, read_clip(tmp_path / "b.bvh"))) < 1e-3


def test_moving_bone_is_kept_rigid_and_told(tmp_path: Path) -> None:
    rows = []
    for t in range(5):
        rows.append(" ".join([f"0 0 {t} 0 0 0", "0 90 0 0 0 0", f"0 {65 + t} 0 0 0 0", "0 0 0"]))
    clip = read_clip(put(tmp_path, "a.bvh", bvh_text(rows, header=TRAVEL)))
    np.testing.assert_allclose(clip.skeleton.offsets[2], [0, 0, 0.67], atol=1e-12)
    notes = [n for n in clip.skeleton.source.notes if "'Head'" in n]
    assert notes == [
        "Joint 'Head' moves against its parent by up to 20.0 mm; its bone is kept rigid at the median"
    ]


def test_world_position_channels(tmp_path: Path) -> None:
    header = BVH_HEADER.replace(
        "CHANNELS 3 Yrotation Xrotation", "CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation"
    )
    plain = read_clip(put(tmp_path, "plain.bvh", bvh_text()))
    heads = plain.positions()[:, 2] * 100
    rows = []
    for row, (x, y, z) in zip(bvh_rows(), heads, strict=True):
        v = row.split()
        # The head's place in the file's axes: (x, z, -y).
        rows.append(" ".join([*v[:9], f"{x:.9f} {z:.9f} {-y:.9f}", *v[9:]]))
    clip = read_clip(put(tmp_path, "a.bvh", bvh_text(rows, header=header)))
    assert any("'Head' hold places in the world" in n for n in clip.skeleton.source.notes)
    assert max(same(plain, clip)) < 1e-3
    write_clip(clip, tmp_path / "b.bvh")
    got = np.loadtxt((tmp_path / "b.bvh").read_text().splitlines()[-8:])
    np.testing.assert_allclose(got, np.array([[float(x) for x in r.split()] for r in rows]), atol=2e-6)


def test_inserted_rest_frame_is_dropped(tmp_path: Path) -> None:
    rest = " ".join(["0", "90", "0"] + ["0"] * 15)
    moving = [" ".join([f"0 90 {0.1 * t}", "80 5 3", *["4"] * 12]) for t in range(30)]
    clip = read_clip(put(tmp_path, "a.bvh", bvh_text([rest, *moving])))
    assert clip.frames == 30
    assert clip.skeleton.source.notes[0].startswith("Frame 0 is a rest pose that was put before")
    # A converter that smooths over the jump leaves frames that are no motion either.
    eased = [" ".join(["0 90 0", "5 5 3", *[f"{angle}"] * 12]) for angle in (10, 30, 42, 48, 50)]
    still = [" ".join(["0 90 0", "5 5 3", *[f"{50 + 0.1 * t:.2f}"] * 12]) for t in range(1, 30)]
    clip = read_clip(put(tmp_path, "c.bvh", bvh_text([rest, *eased, *still])))
    assert clip.frames == 30
    assert clip.skeleton.source.mended == (("rest frame", "", 0, 4, 5.0),)
    # A motion that merely starts from rest keeps its first frame.
    slow = [" ".join([f"0 90 {t}", f"{t} 0 0", *["0"] * 12]) for t in range(30)]
    assert read_clip(put(tmp_path, "b.bvh", bvh_text(slow))).frames == 30


def test_teleports_are_told(tmp_path: Path) -> None:
    rows = [" ".join([f"0 90 {t + (80 if t >= 20 else 0)}", "5 0 0", *["0"] * 12]) for t in range(40)]
    clip = read_clip(put(tmp_path, "a.bvh", bvh_text(rows)))
    assert "The root jumps at frame 20 (0.81 m); the jumps were kept" in clip.skeleton.source.notes


def test_extra_rows_and_one_frame(tmp_path: Path) -> None:
    clip = read_clip(put(tmp_path, "a.bvh", bvh_text(bvh_rows(8), frames=6)))
    assert clip.frames == 6
    assert clip.skeleton.source.notes[0] == "2 rows after the stated 6 frames were left out"


def test_carriage_returns_and_byte_order_mark(tmp_path: Path) -> None:
    text = b"\xef\xbb\xbf" + bvh_text().replace("\n", "\r\n").encode()
    assert read_clip(put(tmp_path, "a.bvh", text)).frames == 8


def test_write_other_orders_units_axes(tmp_path: Path) -> None:
    clip = read_clip(put(tmp_path, "a.bvh", bvh_text()))
    bare = clip.replaced(
        skeleton=Skeleton(*(getattr(clip.skeleton, f) for f in ("names", "parents", "offsets", "ends")))
    )
    for order, unit, up in (("XYZ", 0.01, "Y"), ("YZX", 1.0, "Z"), ("ZYX", 0.0254, "Z")):
        path = tmp_path / f"{order}.bvh"
        write_bvh(bare, path, unit_m=unit, up_axis=up, order=order)
        back = read_clip(path)
        assert max(same(bare, back)) < 2e-2
        assert (back.skeleton.source.unit_m, back.skeleton.source.up_axis) == (unit, up)
        assert f"CHANNELS 3 {order[0]}rotation" in path.read_text()


def test_joint_order_need_not_be_depth_first(tmp_path: Path) -> None:
    skeleton = Skeleton(
        ("root", "head", "lfoot", "tip"),
        (-1, 0, 0, 1),
        np.array([[0, 0, 0], [0, 0, 0.7], [0.1, 0, -0.9], [0, 0, 0.2]]),
    )
    rng = np.random.default_rng(3)
    rot = rng.normal(size=(5, 4, 4)) * 0.2 + [2, 0, 0, 0]
    clip = Clip(
        skeleton, rng.normal(size=(5, 3)) * 0.1, rot / np.linalg.norm(rot, axis=-1)[..., None], 30
    )
    write_clip(clip, tmp_path / "a.bvh")
    back = read_clip(tmp_path / "a.bvh", up_axis="Y", unit_m=0.01)
    assert back.skeleton.names == ("root", "head", "tip", "lfoot")
    assert max(same(clip, back)) < 1e-2


def test_fewer_channels_grow_only_when_needed(tmp_path: Path) -> None:
    header = BVH_HEADER.replace("CHANNELS 3 Yrotation Xrotation Zrotation", "CHANNELS 1 Xrotation")
    rows = [" ".join(r.split()[:10] + r.split()[12:]) for r in bvh_rows()]
    clip = read_clip(put(tmp_path, "a.bvh", bvh_text(rows, header=header)))
    write_clip(clip, tmp_path / "b.bvh")
    assert "CHANNELS 1 Xrotation" in (tmp_path / "b.bvh").read_text()
    assert max(same(clip, read_clip(tmp_path / "b.bvh"))) < 1e-3
    rot = clip.rot.copy()
    rot[:, 2] = rot[:, 3]
    bent = clip.replaced(rot=rot)
    write_clip(bent, tmp_path / "c.bvh")
    assert "CHANNELS 1 Xrotation" not in (tmp_path / "c.bvh").read_text()
    assert max(same(bent, read_clip(tmp_path / "c.bvh"))) < 1e-3


def test_writing_refuses_and_leaves_nothing(tmp_path: Path) -> None:
    clip = read_clip(put(tmp_path, "a.bvh", bvh_text()))
    for target, what in (
        (
            tmp_path / "none" / "b.bvh",
            "the file cannot be written (No such file or directory). Choose a folder you may write to",
        ),
        (
            tmp_path / "a.bvh" / "b.bvh",
            "the file cannot be written (Not a directory). Choose a folder you may write to",
        ),
        (
            tmp_path / "b.c3d",
            f"a clip cannot be written as '.c3d'. Suffixes that can be written: {', '.join(WRITERS)}",
        ),
    ):
        with pytest.raises(PoiseError) as error:
            write_clip(clip, target)
        assert str(error.value) == f"{target}: {what}"
    (tmp_path / "dir.bvh").mkdir()
    with refused("is-folder"):
        write_clip(clip, tmp_path / "dir.bvh")
    with refused("bad-axis-order"):
        write_bvh(clip, tmp_path / "b.bvh", order="XYX")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.bvh", "dir.bvh"]


REAL = (
    "cmu_bvh/ad/14_14.bvh",
    "cmu_bvh/ad/back_handspring1_autolabel.bvh",
    "cmu_bvh/ad/heiansyodan.bvh",
    "cmu_bvh/ad/dance001.bvh",
    "cmu_bvh/acrnn_salsa/10.bvh",
    "cmu_bvh/fairmotion/01_01.bvh",
    "lafan1_bvh/walk4_subject1.bvh",
    "other/mass_bvh/cart.bvh",
    "other/xsens_bvh/251021_04_boxing_120Hz_cm_3DsMax.bvh",
    "other/bandai_bvh/dataset-2_walk_active_005.bvh",
    "other/bandai_bvh/dataset-1_walk_normal_002.bvh",
    "noisy/rokoko_video/jesse_dance.bvh",
)


@pytest.mark.parametrize("name", REAL)
def test_real_dialects_survive_write_and_read(data_dir: Path, tmp_path: Path, name: str) -> None:
    clip = trim(read_clip(data_dir / name), 0, 240)
    write_clip(clip, tmp_path / "b.bvh")
    back = read_clip(tmp_path / "b.bvh")
    distance, angle = same(clip, back)
    assert distance < 1.0 and angle < 0.1
    a, b = clip.skeleton, back.skeleton
    assert a.names == b.names and a.parents == b.parents and clip.fps == back.fps
    assert len(a.ends) == len(b.ends)
    for field in ("unit_m", "up_axis", "channels", "frame_time", "travel_joint"):
        assert getattr(a.source, field) == getattr(b.source, field)
    header = [w for w in (data_dir / name).read_text().split("MOTION")[0].split() if w.isalpha()]
    assert header == [
        w for w in (tmp_path / "b.bvh").read_text().split("MOTION")[0].split() if w.isalpha()
    ]


def test_lafan1_reads_in_a_second(data_dir: Path) -> None:
    start = time.perf_counter()
    clip = read_clip(data_dir / "lafan1_bvh/walk4_subject1.bvh")
    assert clip.frames == 4918
    assert time.perf_counter() - start < 3.0  # 0.3 s alone; the machine may be shared.


def test_root_without_position_channels(tmp_path: Path) -> None:
    header = BVH_HEADER.replace("OFFSET 0 0 0", "OFFSET 5 90 7", 1).replace(
        "CHANNELS 6 Xposition Yposition Zposition", "CHANNELS 3"
    )
    rows = [" ".join(r.split()[3:]) for r in bvh_rows()]
    clip = read_clip(put(tmp_path, "a.bvh", bvh_text(rows, header=header)))
    np.testing.assert_allclose(clip.root_pos, [[0.05, -0.07, 0.9]] * 8)
    write_clip(clip, tmp_path / "b.bvh")
    assert "position" not in (tmp_path / "b.bvh").read_text()
    assert max(same(clip, read_clip(tmp_path / "b.bvh"))) < 1e-3
    moved = clip.replaced(root_pos=clip.root_pos + np.arange(8)[:, None] * 0.01)
    write_clip(moved, tmp_path / "c.bvh")
    assert max(same(moved, read_clip(tmp_path / "c.bvh"))) < 1e-3
