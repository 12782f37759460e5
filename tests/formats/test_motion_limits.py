"""What every format refuses alike: rates, lengths and tables that would take for ever or all memory."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from handmade_gltf_files import put as put_gltf
from handmade_motion_files import bvh_text, deepmimic_row, deepmimic_text, put
from handmade_numpy_files import amass, odd_clip, poselib, save_npy, save_npz
from test_gltf_errors import walker
from test_points_files import NAMES, trc_text, walking

from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from poise.formats import text as bounded
from poise.motion import resample
from poise.motion.clip import MAX_POSES, check_poses
from refusals import refused

RATE = "the frame rate must be from 0.1 to 2000 per second, got "


def refusal(path: Path, *told: Any, **options: object) -> str:
    start = time.process_time()
    with refused(*told) if told else pytest.raises(PoiseError) as error:
        read_clip(path, **options)  # type: ignore[arg-type]
    assert time.process_time() - start < 3.0
    message = str(error.value)
    assert message.startswith(str(path)) and "\n" not in message and len(message) < len(str(path)) + 250
    return message.removeprefix(str(path))


def slow_files(folder: Path, fps: float) -> list[Path]:
    """One file of each format, at a rate that no motion has."""
    step = min(1.0 / fps, 1e308)
    bvh = bvh_text().replace("Frame Time: 0.02", f"Frame Time: {step!r}")
    assert repr(step) in bvh
    own = odd_clip()
    write_clip(own, folder / "own.poise.npz")
    write_clip(own, folder / "own.csv")
    arrays = {**np.load(folder / "own.poise.npz"), "fps": np.array(fps)}
    text = (folder / "own.csv").read_text().replace(f"# fps: {own.fps!r}", f"# fps: {fps!r}")
    points = {"positions": walking(), "names": np.array(NAMES), "fps": np.array(fps)}
    return [
        put(folder, "a.bvh", bvh),
        put(folder, "a.txt", deepmimic_text([deepmimic_row(t, step) for t in range(6)])),
        put(folder, "a.trc", trc_text(rate=repr(fps))),
        save_npz(folder / "own.npz", arrays),
        put(folder, "own.csv", text),
        save_npz(folder / "points.npz", points),
        save_npz(folder / "amass.npz", {**amass(66), "mocap_framerate": np.array(fps)}),
        save_npy(folder / "poselib.npy", {**poselib(), "fps": fps}),
    ]


@pytest.mark.parametrize("fps", [1e-5, 2001.0, 1e5, 1e7])
def test_rates_that_no_motion_has_are_refused_in_every_format(tmp_path: Path, fps: float) -> None:
    for path in slow_files(tmp_path, fps):
        assert RATE in refusal(path, allow_pickle=True), path


@pytest.mark.parametrize("fps", [1e-300, 1e300, 5e-324])
def test_numbers_at_the_ends_of_their_range(tmp_path: Path, fps: float) -> None:
    with np.errstate(over="ignore"):
        for path in slow_files(tmp_path, fps):
            refusal(path, allow_pickle=True)


def test_a_stated_rate_mends_the_file(tmp_path: Path) -> None:
    path = save_npz(tmp_path / "a.npz", {**amass(66), "mocap_framerate": np.array(1e7)})
    assert read_clip(path, fps=60).fps == 60.0
    with refused("rate-out-of-range"):
        resample(read_clip(path, fps=60), 1e9)


def test_motion_of_too_many_frames_is_refused(tmp_path: Path) -> None:
    check_poses(MAX_POSES // 22, 22)
    with refused("clip-too-long", says="20000000"):
        check_poses(MAX_POSES // 22 + 1, 22)
    data = {
        **amass(66),
        "poses": np.zeros((1_000_000, 66), "f2"),
        "trans": np.zeros((1_000_000, 3), "f2"),
    }
    path = tmp_path / "a.npz"
    np.savez_compressed(path, **data)
    assert path.stat().st_size < 1 << 20
    refusal(path, "clip-too-long", ("1000000", "22"))


def test_tables_of_many_or_long_labels_are_refused_at_once(tmp_path: Path) -> None:
    many = tuple(f"m{k}" for k in range(20_000))
    path = put(tmp_path, "a.trc", trc_text(np.zeros((2, 20_000, 3)), many))
    refusal(path, "too-many-joints", ("20000", "1500"))
    path = put(tmp_path, "b.trc", trc_text(names=("_" * 20_000, *NAMES[1:])))
    assert refusal(path).endswith("has a name of 20000 characters")


def test_a_comment_of_one_long_word_takes_no_time(tmp_path: Path) -> None:
    header = ",".join(f"{n}_{a}" for n in NAMES for a in "xyz")
    path = put(tmp_path, "a.csv", f"# \x0b{header}\x0b{'a' * 100_000}\n{header}\n1,2\n")
    refusal(path)


def test_json_that_would_take_gigabytes_is_refused_unread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, _ = walker()
    file.doc["extras"] = [{}] * 3000
    assert len(read_clip(put_gltf(tmp_path, "a.gltf", file)).skeleton) > 1
    monkeypatch.setattr(bounded, "MAX_CONTAINERS", 3000)
    refusal(tmp_path / "a.gltf", "over-limit", "3000")
    monkeypatch.setattr(bounded, "MAX_CONTAINERS", 10_000)
    monkeypatch.setattr(bounded, "MAX_ITEMS", 3000)
    refusal(tmp_path / "a.gltf", "over-limit", ("items", "3000"))
    assert refusal(put(tmp_path, "b.txt", deepmimic_text([deepmimic_row(t) for t in range(90)])))
