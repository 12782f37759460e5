"""Clips to coordinates, back, and out to a file: every joint where it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from poise.body import generate_table
from poise.formats import read_clip, write_clip
from poise.kinematics import Kinematics, clip_to_qpos, fit_humanoid, qpos_to_clip
from poise.motion import Clip, trim
from refusals import refused
from toy_human import human, swing

#: Clip, its ASF, first frame (an inserted T-pose is left out).
CLIPS = {
    "cmu_amc/02/02_01.amc": ("", 0),
    "cmu_amc/rfc/90_02.amc": ("cmu_amc/rfc/08.asf", 0),
    "other/bandai_bvh/dataset-1_walk-right_angry_001.bvh": ("", 0),
    "lafan1_bvh/walk4_subject1.bvh": ("", 0),
    "cmu_bvh/acrnn_indian/04.bvh": ("", 1),
    "deepmimic_txt/humanoid3d_walk.txt": ("", 0),
}


def load(folder, name: str) -> Clip:
    asf, start = CLIPS[name]
    clip = read_clip(folder / name, skeleton=folder / asf if asf else None)
    return trim(clip, start, min(clip.frames, 250))


def gaps(a: Clip, b: Clip) -> np.ndarray:
    """`(J,)` mm, the largest distance of each joint between two clips."""
    return 1000 * np.linalg.norm(a.positions() - b.positions(), axis=-1).max(0)


@pytest.mark.parametrize("name", CLIPS)
def test_there_and_back_and_through_a_file(data_dir, tmp_path, name):
    clip = load(data_dir, name)
    table = generate_table(clip.skeleton, None, [clip])
    qpos = clip_to_qpos(clip, table)
    whole = qpos_to_clip(qpos, table, clip.skeleton, clip.fps, template=clip)
    bodies = Kinematics(table)(qpos).pos
    kept = [r.joint for r in table.rows]
    # Every joint is where it was, those without a body too; so is every body but the head of the CMU
    # humanoid, which rides rigidly on the lower neck while the upper neck turns by a centimetre.
    assert gaps(whole, clip).max() < 1e-3
    apart = 1000 * np.linalg.norm(bodies - clip.positions()[:, kept], axis=-1).max(0)
    worst = {row.name: gap for row, gap in zip(table.rows, apart, strict=True) if gap > 1e-3}
    assert worst.keys() <= {"head"} and all(gap < 20 for gap in worst.values())
    file = tmp_path / "back.bvh"
    write_clip(whole, file)
    again = read_clip(file)
    # A BVH lists joints depth first; the names stay.
    order = [again.skeleton.index(n) for n in clip.skeleton.names]
    assert len(order) == len(again.skeleton) and again.frames == clip.frames
    assert again.fps == pytest.approx(clip.fps, rel=1e-4)
    gap = 1000 * np.linalg.norm(again.positions()[:, order] - clip.positions(), axis=-1)
    assert gap.max() < 1.0


def test_the_toy_comes_back_exactly():
    clip = swing(speed=1.0, bend=1.0)
    table = generate_table(clip.skeleton)
    qpos = clip_to_qpos(clip, table)
    assert gaps(qpos_to_clip(qpos, table, clip.skeleton, 30.0, clip), clip).max() < 1e-6
    bare = qpos_to_clip(qpos, table, clip.skeleton, 30.0)
    kept = [r.joint for r in table.rows]
    assert gaps(bare, clip)[kept].max() < 1e-6
    toe = clip.skeleton.index("LeftToe")
    assert bare.rot[:, toe].tolist() == [[1.0, 0, 0, 0]] * clip.frames


def test_another_motion_keeps_the_templates_fingers_and_the_helpers_above_the_pelvis(data_dir):
    clip = load(data_dir, "other/bandai_bvh/dataset-1_walk-right_angry_001.bvh")
    table = generate_table(clip.skeleton, None, [clip])
    qpos = clip_to_qpos(clip, table)
    qpos[:, :3] += [1.0, 2.0, 0.3]
    moved = qpos_to_clip(qpos, table, clip.skeleton, clip.fps, template=clip)
    np.testing.assert_allclose(
        moved.positions()[:, 1:], clip.positions()[:, 1:] + [1, 2, 0.3], atol=1e-6
    )
    toe = clip.skeleton.index("Toes_L")
    np.testing.assert_allclose(moved.rot[:, toe], clip.rot[:, toe], atol=1e-9)
    np.testing.assert_allclose(moved.rot[:, 0], clip.rot[:, 0], atol=1e-9)


def test_angles_never_jump():
    qpos = fit_humanoid(swing(bend=20.0))[1][0]
    assert np.abs(np.diff(qpos[:, 7:], axis=0)).max() < 0.3
    dots = (qpos[1:, 3:7] * qpos[:-1, 3:7]).sum(-1)
    assert dots.min() > 0


def test_mistakes_are_told():
    clip = swing()
    table = generate_table(clip.skeleton)
    qpos = clip_to_qpos(clip, table)
    with refused("length-differs", says=("11", "31")):
        qpos_to_clip(qpos, table, clip.skeleton, 30.0, template=trim(clip, 0, 11))
    names = tuple("x" + n for n in human().names)
    other = clip.replaced(skeleton=replace(human(), names=names))
    with refused("skeleton-differs", says="swing"):
        clip_to_qpos(other, table)
