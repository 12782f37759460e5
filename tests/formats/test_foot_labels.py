"""Labels of foot contacts that a file brings are read, and taken in place of guesses."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import pytest

from poise.formats import read_clip
from poise.formats.named_arrays import SKELETONS
from poise.formats.smpl import LAYOUTS
from poise.kinematics import anatomy_of, examine, retarget, support_of
from poise.motion import Clip, trim
from poise.motion.clip import backwards
from poise.motion.mirror import mirrored_clip
from poise.motion.roles import find_roles
from poise.motion.skeleton import rest_positions
from refusals import refused

FRAMES = 30
#: Joints of the walk that comes with Poise, in the order of SMPL.
SMPL = (
    *("Hips", "LeftUpLeg", "RightUpLeg", "Spine", "LeftLeg", "RightLeg", "Spine1", "LeftFoot"),
    *("RightFoot", "Spine2", "LeftToe", "RightToe", "Neck", "LeftShoulder", "RightShoulder", "Head"),
    *("LeftArm", "RightArm", "LeftForeArm", "RightForeArm", "LeftHand", "RightHand"),
)


def offsets_of(names: tuple[str, ...]) -> np.ndarray:
    """Bones `(J, 3)` m of a body that stands, Y up: SMPL-X's; others have legs that reach the floor."""
    table = dict(zip(LAYOUTS[0].names, LAYOUTS[0].offsets, strict=True))
    out = np.array([table.get(n, (0.01, 0.06, 0.01)) for n in names]) * 1.0
    for j, name in enumerate(names):
        if name.endswith(("Leg", "Shin", "Foot")):
            out[j] = (0.05 if name.startswith("Left") else -0.05, -0.3, 0.0)
    return out


def kimodo(path: Path, count: int = 22, **labels: np.ndarray) -> Clip:
    """A standing body as Kimodo writes it, read again."""
    names, parents = SKELETONS[count]
    pos = np.tile(rest_positions(parents, offsets_of(names)), (FRAMES, 1, 1))
    pos[..., 1] -= pos[..., 1].min()
    turns = np.tile(np.eye(3), (FRAMES, len(names), 1, 1))
    np.savez(path, posed_joints=pos, global_rot_mats=turns, **labels)  # type: ignore[arg-type]
    return read_clip(path)


def labels(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((FRAMES, 4)) < 0.5


@pytest.mark.parametrize("count", sorted(SKELETONS))
def test_kimodos_labels_are_those_of_its_feet(tmp_path: Path, count: int) -> None:
    told = labels()
    clip = kimodo(tmp_path / "k.npz", count, foot_contacts=told)
    feet = [find_roles(clip.skeleton).joint(f"{side}_foot") for side in ("left", "right")]
    assert [j for j, _ in clip.contacts] == feet
    np.testing.assert_array_equal(np.concatenate([t for _, t in clip.contacts], 1), told)
    assert any("in place of a guess" in n for n in clip.skeleton.source.notes)
    # Two labels are those of whole feet; numbers hold from a half on.
    two = kimodo(tmp_path / "k.npz", count, foot_contact=0.9 * told[:, [0, 2]])
    np.testing.assert_array_equal(two.contacts[1][1], told[:, [2, 2]])


@pytest.mark.parametrize(
    ("value", "why"),
    [
        (np.ones((FRAMES + 1, 4)), "they are 31 x 4, not 30 x 4"),
        (np.ones((FRAMES, 3)), "they are 30 x 3"),
        (np.full((FRAMES, 4), "yes"), "they are 30 x 4, not 30 x 4 truth values"),
        (np.full((FRAMES, 4), np.nan), "do not lie between 0 and 1"),
        (np.full((FRAMES, 4), 7), "do not lie between 0 and 1"),
        (np.zeros((FRAMES, 4), dtype=bool), "no foot ever touches"),
    ],
)
def test_labels_that_say_nothing_are_left_out(tmp_path: Path, value: np.ndarray, why: str) -> None:
    clip = kimodo(tmp_path / "k.npz", foot_contacts=value)
    assert not clip.contacts
    assert any(why in n for n in clip.skeleton.source.notes)


def test_labels_stay_with_their_frames_and_sides(tmp_path: Path) -> None:
    told = labels(1)
    clip = kimodo(tmp_path / "k.npz", foot_contacts=told)
    np.testing.assert_array_equal(trim(clip, 5, 20).contacts[0][1], told[5:20, :2])
    np.testing.assert_array_equal(backwards(clip).contacts[1][1], told[::-1, 2:])
    assert dict(mirrored_clip(clip).contacts)[clip.contacts[0][0]] is clip.contacts[1][1]
    assert not clip.replaced(root_pos=clip.root_pos[::2], rot=clip.rot[::2]).contacts


def test_labels_are_taken_in_place_of_guesses(tmp_path: Path) -> None:
    told = np.zeros((FRAMES, 4), dtype=bool)
    told[:12] = True
    told[18:, 2:] = True
    clip = kimodo(tmp_path / "k.npz", foot_contacts=told)
    # It goes 20 cm from frame 12 to 18, on soles that never leave the floor.
    path = np.array(clip.root_pos)
    path[:, 0] += 0.2 * np.clip((np.arange(FRAMES) - 11) / 7, 0, 1)
    clip = clip.replaced(root_pos=path)
    support = support_of(clip, anatomy_of(clip))
    assert support is not None
    np.testing.assert_array_equal(support.contacts[1], told[1:] & told[:-1])
    guessed = clip.replaced(contacts=())
    kinds = [{f.kind for f in examine(c).faults} for c in (clip, guessed)]
    assert "foot slide" in kinds[1] and "foot slide" not in kinds[0]
    # A body that is moved over is held where the file says so.
    onto = kimodo(tmp_path / "o.npz", 22)
    held, free = (retarget(c, onto)[0] for c in (clip, guessed))
    assert np.abs(held.positions() - free.positions()).max() < 1.0
    assert not held.contacts


def features_of(joints: np.ndarray, touch: np.ndarray) -> np.ndarray:
    """The features `(T - 1, 263)` of joints `(T, 22, 3)`, Y up, by the equations of Guo et al. 2022;
    turns and velocities, which tell no place, are left at zero."""
    across = joints[:, 1] - joints[:, 2] + joints[:, 16] - joints[:, 17]
    ahead = np.cross([0.0, 1.0, 0.0], -across)
    # q turns what the body faces onto +z; half its angle about y.
    half = -0.5 * np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 2]))

    def turned(v: np.ndarray, half: np.ndarray) -> np.ndarray:
        c, s = np.cos(2 * half), np.sin(2 * half)
        return np.stack((c * v[..., 0] + s * v[..., 2], v[..., 1], -s * v[..., 0] + c * v[..., 2]), -1)

    half = half - half[0]
    out = np.zeros((len(joints) - 1, 263))
    out[:, 0] = np.diff(half)
    out[:, 1:3] = turned(np.diff(joints[:, 0], axis=0), half[1:])[:, [0, 2]]
    out[:, 3] = joints[:-1, 0, 1]
    local = joints[:, 1:] - joints[:, :1] * [1.0, 0.0, 1.0]
    out[:, 4:67] = turned(local, half[:, None])[:-1].reshape(len(out), -1)
    out[:, 259:] = touch[: len(out)]
    return out


def test_features_of_humanml3d_give_their_joints_and_their_labels(tmp_path: Path) -> None:
    with as_file(files("poise") / "data/walk.bvh") as path:
        walk = read_clip(path)
    x, y, z = np.moveaxis(walk.positions()[:, [walk.skeleton.names.index(n) for n in SMPL]], -1, 0)
    joints = np.stack((x, z, -y), -1)
    angle = np.linspace(0, 1.5, len(joints))[:, None]
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = np.moveaxis(joints, -1, 0)
    travel = np.stack((0.5 * angle, 0 * angle, angle**2), -1)
    joints = np.stack((c * x + s * z, y, -s * x + c * z), -1) + travel
    touch = np.random.default_rng(0).random((len(joints), 4)) < 0.5
    np.save(tmp_path / "features.npy", features_of(joints, touch))
    np.save(tmp_path / "joints.npy", joints[:-1])
    clip, same = read_clip(tmp_path / "features.npy"), read_clip(tmp_path / "joints.npy", up_axis="Y")
    assert clip.fps == 20.0 and clip.skeleton.source.format == "humanml3d"
    # The features begin where the root stands, in the direction of the first frame.
    start = (joints[0, 0, 0], -joints[0, 0, 2], 0.0)
    np.testing.assert_allclose(clip.positions(), same.positions() - start, atol=1e-6)
    np.testing.assert_array_equal(np.concatenate([t for _, t in clip.contacts], 1), touch[:-1])


def test_normalised_features_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.random.default_rng(0).standard_normal((60, 263)))
    with refused("features-normalised"):
        read_clip(tmp_path / "a.npy")
