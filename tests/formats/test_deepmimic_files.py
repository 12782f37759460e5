"""DeepMimic files: columns, signs of knees and elbows, lengths of quaternions and frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from handmade_motion_files import deepmimic_row, deepmimic_text, put

from poise.formats import read_clip


def test_straight_body_faces_x_in_z_up(tmp_path: Path) -> None:
    clip = read_clip(put(tmp_path, "a.txt", deepmimic_text()))
    names = clip.skeleton.names
    assert len(names) == 15 and clip.fps == pytest.approx(50.0) and not clip.cyclic
    pos = {n: clip.positions()[2, j] for j, n in enumerate(names)}
    np.testing.assert_allclose(pos["root"], [0.04, 0, 0.85], atol=1e-12)
    np.testing.assert_allclose(pos["neck"], [0.04, 0, 0.85 + 0.236151 + 0.223894], atol=1e-12)
    # Facing +X with Z up, the right side is at -Y.
    np.testing.assert_allclose(pos["right_hip"], [0.04, -0.084887, 0.85], atol=1e-12)
    np.testing.assert_allclose(pos["left_hip"], [0.04, 0.084887, 0.85], atol=1e-12)
    # The right knee bends by 0.5: the shin swings back, to -X.
    shin = pos["right_ankle"] - pos["right_knee"]
    np.testing.assert_allclose(shin, 0.409870 * np.array([-np.sin(0.5), 0, -np.cos(0.5)]), atol=1e-12)
    # The left elbow bends by 0.7: the forearm swings forth, to +X.
    arm = pos["left_wrist"] - pos["left_elbow"]
    np.testing.assert_allclose(arm, 0.258947 * np.array([np.sin(0.7), 0, -np.cos(0.7)]), atol=1e-12)


def test_loop_makes_it_cyclic(tmp_path: Path) -> None:
    assert read_clip(put(tmp_path, "a.txt", deepmimic_text(loop="wrap"))).cyclic


def test_quaternions_are_normalised_and_told(tmp_path: Path) -> None:
    rows = [deepmimic_row(t) for t in range(4)]
    rows[2][8:12] = [0.0, 0.9, 0.0, 0.0]
    clip = read_clip(put(tmp_path, "a.txt", deepmimic_text(rows)))
    np.testing.assert_allclose(np.abs(clip.rot[2, 1]), [0, 1, 0, 0])
    assert clip.skeleton.source.notes == (
        "Quaternions off unit length were normalised, at most by 0.100 (joint 'chest' at frame 2)",
    )


def test_uneven_frames_are_resampled(tmp_path: Path) -> None:
    rows = [deepmimic_row(t, 0.04 if t == 2 else 0.02) for t in range(6)]
    clip = read_clip(put(tmp_path, "a.txt", deepmimic_text(rows)))
    # 0, 0.02, 0.04, 0.08, 0.10, 0.12 s become 7 frames; the one at 0.06 s lies halfway.
    assert clip.frames == 7 and clip.fps == pytest.approx(50.0)
    np.testing.assert_allclose(clip.root_pos[:, 0], [0, 0.02, 0.04, 0.05, 0.06, 0.08, 0.10], atol=1e-9)
    assert "resampled at 50 frames per second" in clip.skeleton.source.notes[0]


def test_real_clips_bend_like_people(data_dir: Path) -> None:
    for name in ("humanoid3d_run", "humanoid3d_walk"):
        clip = read_clip(data_dir / f"deepmimic_txt/{name}.txt")
        pos = clip.positions()
        at = {n: pos[:, j] for j, n in enumerate(clip.skeleton.names)}
        forth = at["root"][-1] - at["root"][0]
        forth /= np.linalg.norm(forth)
        for side in ("left", "right"):
            knee = at[f"{side}_knee"] - (at[f"{side}_hip"] + at[f"{side}_ankle"]) / 2
            elbow = at[f"{side}_elbow"] - (at[f"{side}_shoulder"] + at[f"{side}_wrist"]) / 2
            assert (knee @ forth).mean() > 0.01, "knees point forth"
            assert (elbow @ forth).mean() < -0.01, "elbows point back"
        # The left hip lies on the left of the way.
        left = np.cross([0, 0, 1], forth)
        assert ((at["left_hip"] - at["right_hip"]) @ left).mean() > 0.1
        assert abs(pos[..., 2].min()) < 0.1
