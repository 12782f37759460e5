"""`poise convert` and arrays: pickles are asked for, npz and CSV come out."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from poise.cli.main import main
from poise.formats import read_clip, write_clip
from poise.jobs.library.files import is_motion


def test_a_pickle_is_asked_for_and_becomes_npz_and_csv(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = np.zeros((20, 72))
    poses[:, 54] = np.linspace(0.0, 1.0, 20)
    trans = np.array([[0.0, 115.0, 2.0 * t] for t in range(20)])
    data = {"smpl_poses": poses, "smpl_trans": trans, "smpl_scaling": np.array([100.0])}
    source, target = tmp_path / "a.pkl", tmp_path / "a.npz"
    source.write_bytes(pickle.dumps(data))
    assert main(["convert", str(source), str(target)]) == 2
    assert "Read it with --allow-pickle" in " ".join(capsys.readouterr().err.split())
    assert not target.exists()
    assert main(["convert", str(source), str(target), "--allow-pickle"]) == 0
    assert main(["convert", str(target), str(tmp_path / "a.csv")]) == 0
    with np.load(target) as arrays:
        np.testing.assert_allclose(arrays["poses"], poses, atol=1e-12)
        np.testing.assert_allclose(arrays["trans"], trans / 100, atol=1e-12)
    a, b = read_clip(target), read_clip(tmp_path / "a.csv")
    np.testing.assert_array_equal(a.rot, b.rot)
    # The skeleton stands upright: the file was Y up.
    assert a.positions()[:, a.skeleton.index("head"), 2].min() > 1.3
    # A library takes arrays along, but never a pickle that happens to lie in its folder.
    write_clip(b, tmp_path / "b.poise.npz")
    found = {path.name for path in tmp_path.iterdir() if is_motion(path)}
    assert found == {"a.npz", "a.csv", "b.poise.npz"}
