"""The vertical: stated first, then by what bears the body, then by its posture; doubts are told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from handmade_numpy_files import amass, save_npz
from handmade_people import NAMES, crawl, csv, handstand, in_file, push_ups, trc, walk

import poise
from poise.formats import read_clip, write_bvh
from poise.formats.guess import UPS
from poise.formats.raw import quats_from_z_up, quats_to_z_up, vectors_from_z_up, vectors_to_z_up
from poise.motion import Clip

WALK = Path(poise.__file__).parent / "data/walk.bvh"


def told(clip: Clip) -> str:
    return next((n for n in clip.skeleton.source.notes if "vertical" in n), "")


def put(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


@pytest.mark.parametrize("up", UPS)
def test_every_vertical_is_a_turn_and_back(up: str) -> None:
    """Right-handed stays right-handed, and the file's vertical becomes Z."""
    images = vectors_to_z_up(np.eye(3), up)
    assert np.linalg.det(images) == pytest.approx(1.0)
    axis = np.zeros(3)
    axis["XYZ".index(up[-1])] = -1.0 if up[0] == "-" else 1.0
    np.testing.assert_array_equal(vectors_to_z_up(axis, up), [0.0, 0.0, 1.0])
    rng = np.random.default_rng(0)
    v, q = rng.normal(size=(5, 3)), rng.normal(size=(5, 4))
    np.testing.assert_array_equal(vectors_from_z_up(vectors_to_z_up(v, up), up), v)
    np.testing.assert_array_equal(quats_from_z_up(quats_to_z_up(q, up), up), q)


@pytest.mark.parametrize("up", UPS)
def test_a_walk_is_upright_whatever_the_files_vertical(tmp_path: Path, up: str) -> None:
    """A BVH whose rest pose and motion are turned together, as converters with a camera's axes do it."""
    whole = read_clip(WALK)
    write_bvh(whole, tmp_path / "a.bvh", up_axis=up)
    clip = read_clip(tmp_path / "a.bvh")
    assert clip.skeleton.source.up_axis == up and "uncertain" not in told(clip)
    np.testing.assert_allclose(clip.positions(), whole.positions(), atol=1e-4)
    assert ("head down" in told(clip)) == (up[0] == "-")
    stated = read_clip(tmp_path / "a.bvh", up_axis="Y")
    assert stated.skeleton.source.up_axis == "Y" and not told(stated)


@pytest.mark.parametrize("up", ["Y", "Z", "-Y"])
@pytest.mark.parametrize("motion", [push_ups, crawl], ids=["push-ups", "crawl"])
def test_points_of_who_lies_or_crawls_keep_their_vertical(tmp_path: Path, motion, up: str) -> None:
    """Hands and feet that stand still on one height tell it, though the body lies along another axis."""
    clip = read_clip(put(tmp_path, "a.trc", trc(in_file(motion(), up))))
    assert clip.skeleton.source.up_axis == up and "uncertain; override with --up" in told(clip)
    wrists = clip.positions()[:, [clip.skeleton.index(f"{s}Hand") for s in ("Left", "Right")], 2]
    assert np.median(wrists) < 0.1
    assert np.median(clip.positions()[..., 2].max(1)) < 0.75
    table = read_clip(put(tmp_path, "a.csv", csv(in_file(motion(), up))))
    assert table.skeleton.source.up_axis == up


@pytest.mark.parametrize("up", ["Y", "Z", "-Y", "-Z"])
def test_points_of_who_walks_are_sure(tmp_path: Path, up: str) -> None:
    clip = read_clip(put(tmp_path, "a.trc", trc(in_file(walk(), up))))
    assert clip.skeleton.source.up_axis == up and "uncertain" not in told(clip)
    assert np.median(clip.positions()[:, clip.skeleton.index("Head"), 2]) > 1.5


@pytest.mark.parametrize("up", ["Y", "Z"])
def test_a_handstand_stays_one(tmp_path: Path, up: str) -> None:
    """Hands that stand still bear the body; the feet above sway. It is rare, and told."""
    path = tmp_path / "a.npz"
    np.savez(path, positions=in_file(handstand(), up), names=np.array(NAMES), fps=30.0, unit_m=1.0)
    clip = read_clip(path)
    assert clip.skeleton.source.up_axis == up
    assert "head that is down (uncertain; override with --up -" in told(clip)
    assert np.median(clip.positions()[:, clip.skeleton.index("Head"), 2]) < 0.5
    over = read_clip(path, up_axis=f"-{up}")
    assert np.median(over.positions()[:, over.skeleton.index("Head"), 2]) > -0.5


def lying(along_up: bool = False) -> dict:  # type: ignore[type-arg]
    """AMASS's keys, Z up: the body lies along Y on the floor (or stands along Y) and moves its arms."""
    data = amass(66, 60)
    data["poses"][:, :3] = 0.0
    data["trans"] = np.tile([0.1, 0.3, 0.35], (60, 1))
    data["trans"][:, 2] += 0.05 * np.sin(np.arange(60) / 6.0)
    if along_up:
        # A walk of 2 m along Z, which would be a climb if Z were up; the legs swing as fast as it goes.
        t = np.arange(120) / 60.0
        data["trans"] = np.stack((0 * t, 1.2 + 0 * t, 1.0 * t), -1)
        data["poses"] = np.zeros((120, 66))
        for joint, sign in ((1, 1.0), (2, -1.0)):
            data["poses"][:, 3 * joint] = sign * 0.2 * np.sin(2 * np.pi * t)
    return data


def test_the_keys_of_amass_state_z_up(tmp_path: Path) -> None:
    """A stated vertical holds for who lies as well; a doubt is told with the way to overrule it."""
    clip = read_clip(save_npz(tmp_path / "a.npz", lying()))
    assert clip.skeleton.source.up_axis == "Z"
    heights = clip.positions()[..., 2]
    assert np.median(heights.max(1) - heights.min(1)) < 0.9
    assert "the body lies along Y (if it stands there, state --up Y)" in told(clip)
    over = read_clip(tmp_path / "a.npz", up_axis="Y").positions()[..., 2]
    assert np.median(over.max(1) - over.min(1)) > 1.5
    # The same without AMASS's own name of the rate states nothing.
    data = lying()
    data["fps"] = data.pop("mocap_framerate")
    assert told(read_clip(save_npz(tmp_path / "b.npz", data)))


def test_keys_of_amass_in_a_world_that_is_y_up(tmp_path: Path) -> None:
    clip = read_clip(save_npz(tmp_path / "a.npz", lying(along_up=True)))
    note = next((n for n in clip.skeleton.source.notes if "AMASS" in n), "")
    assert clip.skeleton.source.up_axis == "Y" and "uncertain; override with --up Z" in note


@pytest.mark.parametrize("up", ["-Y", "X", "Z"])
def test_smpl_in_any_vertical_comes_back(tmp_path: Path, up: str) -> None:
    """A stated vertical turns the world; writing turns it back."""
    data = {**amass(66), "up_axis": np.array(up)}
    clip = read_clip(save_npz(tmp_path / "a.npz", data))
    assert clip.skeleton.source.up_axis == up
    poise.write(clip, tmp_path / "b.npz")
    with np.load(tmp_path / "b.npz") as back:
        np.testing.assert_allclose(back["trans"], data["trans"], atol=1e-9)
    np.testing.assert_allclose(read_clip(tmp_path / "b.npz").positions(), clip.positions(), atol=1e-9)
