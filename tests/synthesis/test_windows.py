"""Windows of the LAFAN1 protocol: bounds, places, headings, contacts, skeletons."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from poise.formats import read_clip
from poise.motion import Clip, Skeleton
from poise.motion.rotations import forward_kinematics, quat_rotate
from poise.synthesis.windows import (
    centred,
    cut,
    faced,
    foot_joints,
    pack_frames,
    step_contacts,
    still_root,
    train_statistics,
    window_starts,
    without_still_root,
)
from refusals import refused
from toy_human import human, swing


def test_the_bound_of_windows_is_strict() -> None:
    first = torch.tensor([0, 65, 131, 237])
    # 65 frames hold no window of 65, 66 hold one, 106 two (at 0 and 40)
    assert window_starts(first, 65, 40).tolist() == [65, 131, 171]
    assert window_starts(first, 65, 40, strict=False).tolist() == [0, 65, 131, 171]
    assert window_starts(torch.tensor([0, 10]), 65, 40).tolist() == []


def test_banks_hold_clips_one_after_another() -> None:
    clips = [swing(1.0, name="a"), swing(2.0, speed=1.0, name="b"), swing(1.0, fps=60.0, name="c")]
    bank = pack_frames(clips)
    assert bank.clips == ("a", "b", "c") and bank.first.tolist() == [0, 31, 92, 123]
    assert bank.clip_of(torch.tensor([0, 30, 31, 91, 92])).tolist() == [0, 0, 1, 1, 2]
    assert np.allclose(bank.positions()[31:92], clips[1].positions())
    part = bank.only(lambda name: name != "b")
    assert part.clips == ("a", "c") and part.first.tolist() == [0, 31, 62]
    assert torch.equal(part.root[31:], bank.root[92:])
    with refused("no-clips", says="3"):
        bank.only(lambda name: False)


def test_feet_are_found_by_name_and_the_heading_by_feet() -> None:
    skeleton = human()
    names = [skeleton.names[j] for j in foot_joints(skeleton)]
    assert names == ["LeftFoot", "LeftToe", "RightFoot", "RightToe"]
    bank = pack_frames([swing(1.0)])
    assert bank.facing[0] == pytest.approx(1.0, abs=0.01)
    nameless = Skeleton(("a", "b"), (-1, 0), np.array([[0, 0, 0], [0, 0, 1.0]]))
    with refused("role-missing"):
        foot_joints(nameless)


def test_windows_are_centred_and_face_along_x_at_the_tenth_frame() -> None:
    bank = pack_frames([swing(3.0, speed=1.2, bend=2.0)])
    root, rot, offsets = cut(bank, torch.tensor([0, 20]), 50)
    flat = centred(root)
    assert torch.allclose(flat[..., :2].mean(1), torch.zeros(2, 2, dtype=torch.float64), atol=1e-12)
    assert torch.equal(flat[..., 2], root[..., 2])
    turned, quats = faced(flat, rot, bank.facing)
    axis = torch.tensor(bank.facing, dtype=torch.float64).expand(2, 3)
    ahead = quat_rotate(quats[:, 9, 0], axis)
    assert torch.allclose(ahead[:, 1], torch.zeros(2, dtype=torch.float64), atol=1e-12)
    assert bool((ahead[:, 0] > 0.9).all())
    # Turning moves nothing inside the window: all distances stay.
    before = forward_kinematics(bank.parents, offsets, flat, rot)[0]
    after = forward_kinematics(bank.parents, offsets, turned, quats)[0]
    apart = [(x[:, :, 3] - x[:, 9:10, 7]).norm(dim=-1) for x in (before, after)]
    assert torch.allclose(*apart, atol=1e-12)
    # The twice-turned window is the once-turned one: the heading is +X already.
    assert torch.allclose(faced(turned, quats, bank.facing)[1], quats, atol=1e-12)


def test_statistics_are_those_of_all_frames_of_all_windows() -> None:
    bank = pack_frames([swing(3.0, speed=0.8), swing(4.0, bend=1.0)])
    mean, std = train_statistics(bank, chunk=2)
    root, rot, offsets = cut(bank, window_starts(bank.first, 50, 20), 50)
    root, rot = faced(centred(root), rot, bank.facing)
    pos = forward_kinematics(bank.parents, offsets, root, rot)[0].flatten(0, 1)
    assert torch.allclose(mean, pos.mean(0), atol=1e-10)
    assert torch.allclose(std, pos.std(0, correction=0), atol=1e-7)
    # The root is centred on the ground; the published mean of the hips is (0, height, 0) for that.
    assert torch.allclose(mean[0, :2], torch.zeros(2, dtype=torch.float64), atol=0.2)
    with refused("clip-too-short"):
        train_statistics(pack_frames([swing(1.0)]))


def test_the_two_contacts_are_different_labels() -> None:
    # Steps in mm: 1.4 along x; 1 along each axis (squared 3, L1 3); 0.5 along each (0.75, 1.5)
    steps = torch.tensor([[1.4, 0, 0], [1.0, 1.0, 1.0], [0.5, 0.5, 0.5]], dtype=torch.float64) * 1e-3
    path = torch.cat((torch.zeros(1, 3, dtype=torch.float64), steps.cumsum(0)))[:, None]
    assert step_contacts(path)[:, 0].tolist() == [True, False, True, True]
    assert step_contacts(path, "two-stage")[:, 0].tolist() == [True, False, True, True]
    diagonal = torch.tensor([[0.0, 0, 0], [0.8, 0.8, 0.8]], dtype=torch.float64)[:, None] * 1e-3
    # 3 * 0.64 = 1.92 mm^2 < 2, but 2.4 mm > 2
    assert step_contacts(diagonal)[:, 0].tolist() == [True, True]
    assert step_contacts(diagonal, "two-stage")[:, 0].tolist() == [False, False]
    # 0.02 cm^2 a frame at 30 fps are the 4.2 cm/s of the literature.
    assert math.sqrt(0.02) * 30 == pytest.approx(4.2, abs=0.05)


def test_a_still_root_gives_way_to_its_child() -> None:
    clip = swing(1.0)
    s = clip.skeleton
    names = ("joint_Root", *s.names)
    parents = (-1, *(p + 1 for p in s.parents))
    offsets = np.concatenate((np.zeros((1, 3)), s.offsets))
    still = np.zeros((clip.frames, 1, 4))
    still[..., 0] = 1.0
    rooted = Clip(
        Skeleton(names, parents, offsets), clip.root_pos, np.concatenate((still, clip.rot), 1), 30
    )
    assert still_root(rooted) and not still_root(clip)
    short = without_still_root(rooted)
    assert short.skeleton.names == s.names and np.allclose(short.positions(), clip.positions())
    assert without_still_root(clip) is clip


def test_clips_of_two_skeletons_are_refused() -> None:
    other = Skeleton(("a", "ltoe"), (-1, 0), np.array([[0, 0, 0], [0, 0, 1.0]]))
    rot = np.zeros((40, 2, 4))
    rot[..., 0] = 1.0
    with refused("skeleton-differs"):
        pack_frames([swing(1.0), Clip(other, np.zeros((40, 3)), rot, 30.0)])
    with refused("no-clips"):
        pack_frames([])


def test_lafan1s_skeleton_is_the_published_one(data_dir: Path) -> None:
    clip = read_clip(data_dir / "lafan1_bvh/walk4_subject1.bvh")
    bank = pack_frames([clip])
    assert bank.feet == (3, 4, 7, 8) and len(bank.names) == 22
    assert bank.parents == (-1, 0, 1, 2, 3, 0, 5, 6, 7, 0, 9, 10, 11, 12, 11, 14, 15, 16, 11, 18, 19, 20)
    cm = 100 * bank.offsets[0]
    lengths = {"LeftLeg": 43.5, "LeftFoot": 42.372, "LeftToe": 17.3, "Neck": 25.833, "Head": 11.767}
    for name, length in lengths.items():
        assert cm[bank.names.index(name)].tolist() == pytest.approx([length, 0, 0], abs=1e-3)
    # Y up (x, y, z) is (x, -z, y) here: the hips stand at (0.1035, 1.8578, +-10.5485) in the file.
    assert cm[1].tolist() == pytest.approx([0.1035, -10.5485, 1.8578], abs=1e-3)
    # The protocol's local Y is local Z here; the feet agree with it within 10 degrees.
    assert bank.facing[2] > math.cos(math.radians(10))
