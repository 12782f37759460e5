"""The packed reference: its clips, its seams, its velocities."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from poise.env import Reference
from poise.kinematics import fit_humanoid
from poise.motion import ClipLibrary
from poise.motion.rotations import heading_quat, quat_angle, quat_conj, quat_mul, quat_rotate
from refusals import refused
from toy_human import swing

FIELDS = ("qpos", "qvel", "pos", "quat", "linvel", "angvel", "com", "local", "heading")


def reference_of(*clips) -> Reference:
    library = ClipLibrary(clips)
    humanoid, motions, _ = fit_humanoid(library, None, 30.0)
    return Reference(humanoid, motions, 30.0, library.names, [c.cyclic for c in clips])


def at(*values: int) -> torch.Tensor:
    return torch.tensor(values)


def test_rows_of_several_clips_end_to_end():
    ref = reference_of(swing(1.0), swing(0.5, name="short"))
    assert ref.length.tolist() == [31, 16] and ref.start.tolist() == [0, 31] and ref.frames == 47
    assert ref.seconds == pytest.approx(1.5)
    assert ref.rows(at(0, 1, 1, 0), at(3, 0, 99, 99)).tolist() == [3, 31, 46, 30]
    assert ref.phase(at(0, 1, 1), at(15, 15, 99)).tolist() == [0.5, 1.0, 1.0]
    pose = ref.gather(at(1), at(4))
    torch.testing.assert_close(pose.qpos[0].double(), ref.qpos[35], atol=1e-6, rtol=0)
    assert all(not getattr(pose, f).requires_grad for f in FIELDS)


def test_following_a_frame_equals_looking_up_the_next():
    ref = reference_of(swing(0.5, speed=1.2, bend=0.7, cyclic=True), swing(0.4, name="short"))
    clip, frame = at(0, 1, 0, 1), at(3, 0, 13, 10)
    rows = ref.rows(clip, frame)
    for _ in range(20):
        rows, packed = ref.follow(rows, clip, frame)
        frame = frame + 1
        assert torch.equal(rows, ref.rows(clip, frame))
        assert torch.equal(packed, ref.gather_packed(clip, frame))
        place = ref.layout.place(packed)
        assert torch.equal(place.phase, ref.phase(clip, frame))
        assert torch.equal(place.low, ref.min_height[clip])
        done = (frame >= ref.length[clip] - 1) & ~ref.cyclic[clip]
        assert torch.equal(place.end > 0, done)


def test_a_cyclic_clip_is_carried_on_without_a_seam():
    ref = reference_of(swing(1.0, speed=1.2, bend=0.7, cyclic=True))
    last = 30
    # Frame L-1 is frame 0 carried by one cycle.
    own = ref.pose.pos[last]
    carried = ref.gather(at(0), at(last)).pos[0]
    torch.testing.assert_close(carried[..., :2], own[..., :2], atol=2e-4, rtol=0)
    # Frames L-1+k are frames k turned and moved by the clip's own travel, again and again.
    turn, travel = ref.cycle_turn[0].float(), ref.cycle_travel[0].float()
    for k in range(0, 30, 7):
        pos, quat = ref.pose.pos[k], ref.pose.quat[k]
        lin = ref.pose.linvel[k]
        for cycle in range(1, 4):
            pos = quat_rotate(turn.expand(len(pos), 4), pos) + travel
            quat = quat_mul(turn.expand(len(quat), 4), quat)
            lin = quat_rotate(turn.expand(len(lin), 4), lin)
            got = ref.gather(at(0), at(cycle * last + k))
            torch.testing.assert_close(got.pos[0], pos, atol=1e-5, rtol=1e-5)
            torch.testing.assert_close(got.linvel[0], lin, atol=1e-5, rtol=1e-5)
            assert float(quat_angle(quat_mul(got.quat[0], quat_conj(quat))).max()) < 2e-3
            torch.testing.assert_close(got.qpos[0, :3], got.pos[0, 0])
            torch.testing.assert_close(got.heading[0], heading_quat(got.quat[0, 0]), atol=1e-5, rtol=0)


def test_no_step_across_the_seam_is_larger_than_within():
    ref = reference_of(swing(1.0, speed=1.2, bend=0.7, cyclic=True))
    frames = torch.arange(0, 95)
    pose = ref.gather(torch.zeros_like(frames), frames)
    steps = (pose.pos[1:] - pose.pos[:-1]).norm(dim=-1).amax(-1)
    inside, seams = steps[:29].max(), steps[[29, 30, 59, 60, 89, 90]].max()
    assert float(seams) < 1.15 * float(inside)
    angles = (pose.qpos[1:, 7:] - pose.qpos[:-1, 7:]).abs().amax(-1)
    assert float(angles[[29, 30, 59, 60]].max()) < 1.15 * float(angles[:29].max())


def test_worlds_of_one_batch_may_be_in_different_cycles_and_clips():
    ref = reference_of(swing(1.0, speed=1.0, bend=0.3, cyclic=True), swing(0.5, name="still"))
    clip, frame = at(0, 0, 1, 0), at(5, 65, 200, 35)
    many = ref.gather(clip, frame)
    for i in range(4):
        one = ref.gather(clip[i : i + 1], frame[i : i + 1])
        for f in FIELDS:
            torch.testing.assert_close(getattr(many, f)[i], getattr(one, f)[0])
    torch.testing.assert_close(many.pos[2], ref.pose.pos[-1])


def test_what_is_told_apart_stays_so_joined_and_elsewhere():
    ref = reference_of(swing(1.0), swing(0.5, name="short"))
    motions = [q.numpy() + 0.01 for q in ref.qpos.split(ref.length.tolist())]
    told, elsewhere = ref.told(motions), torch.device("meta")
    assert told.misleads and not ref.misleads
    assert torch.equal(told.goal_rows.judged, ref.goal_rows.judged)
    both = ref.joined(told)
    # The rows of the second reference come after the 47 of the first one.
    rows, goal = both.follow(at(35, 47 + 35, 47 + 46), at(1, 3, 3), at(4, 4, 15))
    assert rows.tolist() == [36, 47 + 36, 47 + 46] and both.misleads
    want = ref.goal_rows.told[36], told.goal_rows.told[36], told.goal_rows.told[46]
    assert torch.equal(goal, torch.stack(want)) and not torch.equal(want[0], want[1])
    assert torch.equal(both.packed(rows), ref.packed(at(36, 36, 46)))
    for own in (ref, told, both):
        there = own.to(elsewhere)
        assert there.misleads == own.misleads and there.goal_rows.after.device == elsewhere
        assert there.goal_rows.told.device == there.qpos.device == elsewhere
    # With other goals for all there is one thing to tell.
    again = told.with_pose(ref.pose)
    assert not again.misleads and torch.equal(again.goal_rows.judged, ref.goal_rows.judged)


def test_velocities_are_those_of_the_path():
    ref = reference_of(swing(1.0, speed=1.2))
    pos = ref.pose.pos
    central = (pos[2:] - pos[:-2]) * 15.0
    torch.testing.assert_close(ref.pose.linvel[1:-1], central, atol=0.02, rtol=0)
    assert ref.min_height[0] == ref.pose.qpos[:, 2].min()


def test_the_centre_of_mass_is_mujocos():
    ref = reference_of(swing(1.0))
    data = mujoco.MjData(ref.humanoid.model)
    for k in (0, 9, 20):
        data.qpos[:] = ref.qpos[k].numpy()
        mujoco.mj_forward(ref.humanoid.model, data)
        np.testing.assert_allclose(ref.pose.com[k], data.subtree_com[1], atol=1e-6)


def test_mistakes_are_told():
    humanoid, motions, _ = fit_humanoid(swing(), None, 30.0)
    with refused("count-differs"):
        Reference(humanoid, motions, 30.0, ["a", "b"])
    with refused("clip-too-short", says=("short", "2")):
        Reference(humanoid, [motions[0][:2]], 30.0, ["short"])
