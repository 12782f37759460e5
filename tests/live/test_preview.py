"""The frames simulated so far, for the page: the places of the character in the world of its motion."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from poise.formats import read_clip
from poise.jobs.track import track
from poise.jobs.track.controllers import DrawsSteps
from poise.live.open.job_processes import drawn_since
from poise.live.open.preview import Preview
from poise.motion import trim
from test_docs import WALK


def rows_of(path: Path, row: int = 0) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """The header, frames and places of a file."""
    data = drawn_since(path, row)
    size = int.from_bytes(data[:4], "little")
    header = json.loads(data[4 : 4 + size])
    rows = np.frombuffer(data[4 + size :], "<f4").reshape(-1, 1 + 3 * len(header["parents"]))
    return header, rows[:, 0].astype(int), rows[:, 1:].reshape(len(rows), -1, 3)


def test_states_are_drawn_where_the_result_has_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("poise.live.open.preview.EVERY_S", 0.0)
    clip = trim(read_clip(WALK), 0, 24)
    told = list[tuple[str, int, int]]()
    preview = Preview(lambda *row: told.append(row), tmp_path / "drawn.bin")
    assert isinstance(preview, DrawsSteps)
    result = track(clip, controller="policy", progress=preview)
    header, frames, pos = rows_of(tmp_path / "drawn.bin")
    assert result.simulation is not None
    assert frames.tolist() == list(range(result.simulation.frames)) and header["frames"] == len(frames)
    assert header["fps"] == result.simulation.rate_hz and told[-1][1:] == (23, 23)
    # The same hips and feet as in what is written, at its size; feet are held to their spots there.
    motion = result.delivered(0, False)
    for role, name, far in (
        ("hips", "Hips", 0.03),
        ("left_foot", "LeftFoot", 0.05),
        ("right_foot", "RightFoot", 0.05),
        ("left_hand", "LeftHand", 0.2),
    ):
        joint = motion.skeleton.names.index(name)
        gap = np.linalg.norm(pos[:, header["roles"][role]] - motion.positions()[:, joint], axis=-1)
        assert gap.max() < far, (role, gap.max())
    # Bones are as long as they are drawn at first.
    lengths = np.linalg.norm(pos - pos[:, np.maximum(header["parents"], 0)], axis=-1)
    np.testing.assert_allclose(lengths, np.broadcast_to(lengths[0], lengths.shape), atol=1e-4)
    _, later, _ = rows_of(tmp_path / "drawn.bin", 20)
    assert later.tolist() == list(range(20, 24))


def test_a_disk_without_room_ends_nothing(tmp_path: Path) -> None:
    clip = trim(read_clip(WALK), 0, 12)
    preview = Preview(lambda *_: None, tmp_path / "gone" / "drawn.bin")
    assert track(clip, controller="policy", progress=preview).simulation is not None
