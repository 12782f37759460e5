"""Motions of any skeleton and keypoints, tracked by a toy policy without help."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from poise.env import ImitationEnv
from poise.formats import read_clip
from poise.formats.point_fit import JOINT_PLACES
from poise.formats.raw import ReadOptions as Options
from poise.jobs.deliver import Evaluation
from poise.jobs.open import open_run
from poise.jobs.track import ResetOnFail, TrackConfig, imitation_of, look_ahead, track
from poise.jobs.track.controllers import NO_CRITIC
from poise.jobs.track.placement import home, place, points_of
from poise.jobs.tracker import Tracker
from poise.kinematics.coords import within_turns
from poise.motion import Clip, Skeleton, ground_shift
from poise.motion.keypoints import Keypoints
from poise.motion.noise import Jitter
from poise.motion.roles import map_joints
from poise.motion.rotations import quat_mul
from poise.plan import LookaheadConfig
from poise.score import Recording, run_episodes, score_rollouts
from refusals import refused
from toy_human import swing
from toy_policy import toy_run, walk


@pytest.fixture(scope="module")
def tracker(tmp_path_factory: pytest.TempPathFactory) -> Tracker:
    return open_run(toy_run(tmp_path_factory.mktemp("run"))).tracker


@pytest.fixture(scope="module")
def pointed(tmp_path_factory: pytest.TempPathFactory) -> Tracker:
    return open_run(toy_run(tmp_path_factory.mktemp("points"), "keypoints")).tracker


def points(clip: Clip) -> Keypoints:
    """What a pose estimator would call the joints of a clip of the toy human."""
    names = {"UpLeg": "Hip", "Leg": "Knee", "Foot": "Ankle", "Toe": "BigToe", "Arm": "Shoulder"}
    names |= {"ForeArm": "Elbow", "Hand": "Wrist"}
    found = {"Neck": "Neck", "Head": "Nose"}
    for side in ("Left", "Right"):
        found |= {f"{side}{joint}": f"{side[0]}{name}" for joint, name in names.items()}
    at = [clip.skeleton.index(j) for j in found]
    return Keypoints(tuple(found.values()), clip.positions()[:, at], clip.fps, "points")


def test_a_clip_on_a_body_with_its_own_bones(tracker: Tracker, tmp_path: Path) -> None:
    clip = shorter()
    own, fixed = (track(clip, tracker, controller="policy", body=b) for b in ("own", "policy"))
    body = own.imitation.humanoid
    assert (body.bodies, body.hinges) == (tracker.humanoid.bodies, tracker.humanoid.hinges)
    assert body.identity != tracker.humanoid.identity and body.mass < tracker.humanoid.mass
    assert fixed.imitation.humanoid.identity == tracker.humanoid.identity
    assert own.placed.moved is not None and own.placed.moved.scale == 1.0
    # Its limbs are where the clip's are, and so are all of its joints when it has come back.
    joints, there = map_joints(clip.skeleton, body.skeleton), own.placed.clip
    a, b = joints.limb_pair("left_foot") or (0, 0)
    np.testing.assert_allclose(there.positions()[:, b], clip.positions()[:, a], atol=1e-6)
    back = home(own.placed.level.onto(there), own.placed, own.tracker)
    np.testing.assert_allclose(back.positions(), clip.positions(), atol=1e-4)
    assert own.clip.skeleton == clip.skeleton
    assert set(own.save(tmp_path)) >= {"simulated", "body", "score", "report"}
    with refused("single-clip-only"):
        track([clip, clip], tracker, body="own")
    with refused("settings-conflict"):
        TrackConfig(body="own", recover=True)


def shorter() -> Clip:
    """A walk of the toy human with other proportions."""
    clip = swing(1.5, 30.0, scale=0.85)
    offsets = clip.skeleton.offsets.copy()
    for side in ("Left", "Right"):
        offsets[clip.skeleton.index(f"{side}Leg")] *= 1.1
    return clip.replaced(skeleton=replace(clip.skeleton, offsets=offsets))


def test_a_clip_on_the_bodys_own_skeleton(tracker: Tracker, tmp_path: Path) -> None:
    clip = walk(0, 40)
    tracked = track(clip, tracker, controller="policy")
    card = tracked.evaluation.card
    assert tracked.placed.moved is None and card.help.limit_n == 0.0 and card.method
    assert card.episodes == 1 and card.succ == 0.0
    (failed,) = tracked.failed_s
    r = tracked.evaluation.rollouts
    far = (r.pos[0] - r.ref_pos[0]).norm(dim=-1).mean(-1)
    first = int((far > 0.5).nonzero()[0])
    assert failed == pytest.approx(first / 30.0)
    motion = tracked.motion()
    assert (motion.frames, motion.fps, motion.skeleton) == (40, 30.0, clip.skeleton)
    done = tracked.write(tmp_path / "out", tmp_path / "out.bvh")
    assert set(done.paths) == {"simulated", "score", "report", "simulation"}
    assert done.paths["simulated"].exists()
    assert json.loads((tmp_path / "out/score.json").read_text())["help"]["limit_n"] == 0.0
    back = read_clip(tmp_path / "out.bvh")
    assert back.skeleton.names == clip.skeleton.names and back.frames == 40
    # The same again gives the same.
    again = track(clip, tracker, controller="policy")
    np.testing.assert_array_equal(
        again.evaluation.recordings[0].qpos, tracked.evaluation.recordings[0].qpos
    )


def test_the_reference_on_the_body_comes_home_as_it_was(tracker: Tracker, tmp_path: Path) -> None:
    """Another skeleton at another size and rate: what goes onto the body comes back."""
    source = swing(1.0, 60.0, speed=1.0, scale=0.9)
    placed = place(source, tracker)
    assert placed.moved is not None and placed.moved.scale != 1.0
    assert placed.clip.skeleton == tracker.humanoid.skeleton
    imitation = imitation_of(tracker, [placed])
    recording = Recording(0, 0, placed.qpos, 0)
    from poise.jobs.deliver import simulated_clip

    made = simulated_clip(imitation, Evaluation(None, None, [recording]))  # type: ignore[arg-type]
    back = home(made, placed, tracker)
    assert (back.frames, back.fps, back.name) == (source.frames, source.fps, "swing")
    assert back.skeleton.names == source.skeleton.names
    off = np.linalg.norm(back.positions() - source.positions(), axis=-1)
    assert off.mean() < 0.05
    # A joint that the body lacks moves as in the source.
    assert np.ptp(back.root_pos[:, 0]) == pytest.approx(np.ptp(source.root_pos[:, 0]), rel=0.05)


def test_what_is_delivered_is_as_high_as_its_source(tracker: Tracker, tmp_path: Path) -> None:
    source = ground_shift(swing(0.5, 60.0, scale=1.1), 0.3)
    tracked = track(source, tracker, controller="policy")
    # The character begins as the motion does.
    for out in (tracked.delivered(hold=False), tracked.clip):
        assert abs(float(out.root_pos[0, 2] - source.root_pos[0, 2])) < 0.03
    assert tracked.motion().root_pos[0, 2] < source.root_pos[0, 2] - 0.1


def test_another_skeleton_gets_its_own_back(tracker: Tracker, tmp_path: Path) -> None:
    source = swing(0.5, 60.0, scale=1.1)
    tracked = track(source, tracker, controller="policy")
    done = tracked.write(tmp_path, tmp_path / "out.npz", hold=False)
    assert set(done.paths) == {"simulated", "body", "score", "report", "simulation"}
    back, body = read_clip(done.paths["simulated"]), read_clip(done.paths["body"])
    assert back.skeleton.names == source.skeleton.names and back.frames == source.frames
    np.testing.assert_allclose(back.skeleton.offsets[1:], source.skeleton.offsets[1:], atol=1e-5)
    assert set(body.skeleton.names) == set(tracker.humanoid.skeleton.names)
    assert any("on another skeleton" in note for note in tracked.notes)


def test_resets_change_nothing_before_the_first_failure(tracker: Tracker) -> None:
    plain = track(walk(), tracker, controller="policy")
    again = track(walk(), tracker, TrackConfig(controller="policy", reset_on_fail=True))
    assert len(again.failed_s) > 1 and again.failed_s[0] == plain.failed_s[0]
    # The score is that of the character that was not put back.
    assert again.evaluation.card.mpjpe_mm == plain.evaluation.card.mpjpe_mm
    assert again.evaluation.card.succ == 0.0
    r, ref = again.evaluation.rollouts, again.imitation.reference
    for second in again.failed_s[:-1]:
        t = round(second * 30)
        far = (r.pos[0] - r.ref_pos[0]).norm(dim=-1).mean(-1)
        # It is recorded where it fell, and one step from the reference afterwards.
        assert far[t] > 0.5 and far[t + 1] < 0.2
    assert ref.length.tolist() == [86]


def test_only_those_that_fell_are_put_back(tracker: Tracker) -> None:
    placed = [place(walk(0, 40), tracker), place(walk(20, 60), tracker)]
    imitation = imitation_of(tracker, placed)
    env = imitation.env(2, auto_reset=False, threads=1, help_scale=0.0)
    keeper = ResetOnFail(env, tracker.policy)
    try:
        obs = env.reset_to(torch.tensor([0, 1]), torch.zeros(2, dtype=torch.long))
        for _ in range(3):
            obs = env.step(tracker.policy.act(obs)).final_obs
        qpos, qvel = env.backend.state.qpos.clone(), env.backend.state.qvel.clone()
        moved = qpos.clone()
        moved[0, 0] += 2.0
        env.backend.write(None, moved, qvel)
        keeper.act(obs)
        assert keeper.fallen == [(0, 3)]
        assert torch.equal(env.backend.state.qpos[1], moved[1])
        want = imitation.reference.coordinates(torch.tensor([0]), torch.tensor([3]))[0]
        assert torch.equal(env.backend.state.qpos[:1], want)
    finally:
        env.close()


def test_keypoints_are_streamed_to_a_policy_of_keypoints(pointed: Tracker) -> None:
    given = points(swing(1.0, 60.0, speed=0.5))
    tracked = track(given, pointed, controller="policy")
    assert any("Each goal comes from the keypoints" in note for note in tracked.notes)
    fit = imitation_of(pointed, [tracked.placed]).reference.pose
    pose = tracked.imitation.reference.pose
    off = (pose.pos - fit.pos).norm(dim=-1)
    # The stream differs from the offline fit, and follows the same motion.
    assert 1e-4 < float(off.mean()) < 0.05
    speed = (pose.pos[2:] - pose.pos[:-2]) * 15.0
    assert torch.allclose(pose.linvel[1:-1], speed, atol=0.02)
    # With gaps and noise it goes on.
    noisy = track(
        given, pointed, TrackConfig(controller="policy", noise=(Jitter(strength=0.2),), seed=1)
    )
    assert any("without noise" in note for note in noisy.notes)


def test_keypoints_are_fitted_for_a_policy_of_rotations(tracker: Tracker, pointed: Tracker) -> None:
    given = points(swing(0.5, 60.0))
    tracked = track(given, tracker, controller="policy")
    assert any("fitted to the keypoints" in note for note in tracked.notes)
    assert set(tracked.placed.source.skeleton.names) >= set(JOINT_PLACES) - {"Neck", "Head"}
    lost = given.positions.copy()
    lost[:, given.names.index("Nose")] = np.nan
    lost[5:8, given.names.index("LWrist")] = np.nan
    holes = given.replaced(positions=lost)
    assert any("longest gap" in note for note in track(holes, pointed, controller="policy").notes)


def test_files_of_keypoints_are_known(data_dir: Path) -> None:
    folder = data_dir / "noisy/pose2sim/single"
    path = next(iter(sorted(folder.glob("*.trc"))))
    clip = read_clip(path)
    found = points_of(clip, Options())
    assert found is not None and found.frames >= clip.frames
    assert points_of(walk(), Options()) is None


def test_noise_moves_the_input_and_says_so(tracker: Tracker) -> None:
    config = TrackConfig(controller="policy", noise=(Jitter(),), seed=4)
    tracked = track(walk(0, 30), tracker, config)
    (note,) = [n for n in tracked.notes if "without noise" in n]
    assert "input with noise" in note
    assert track(walk(0, 30), tracker, config).notes == tracked.notes
    other = track(walk(0, 30), tracker, replace(config, seed=5))
    assert not np.array_equal(other.placed.qpos, tracked.placed.qpos)


def test_angles_come_within_a_turn_of_their_ranges(tracker: Tracker) -> None:
    qpos = place(walk(0, 20), tracker).qpos
    turned = qpos.copy()
    turned[:, 9] += 4 * np.pi
    turned[:, 11] -= 2 * np.pi
    np.testing.assert_allclose(within_turns(turned, tracker.humanoid), qpos, atol=1e-9)


def test_it_agrees_with_an_evaluation_of_the_run(tracker: Tracker) -> None:
    """A clip on the body's skeleton is scored as the run's own evaluation would score it."""
    tracked = track(walk(0, 30), tracker, controller="policy")

    def make(worlds: int) -> ImitationEnv:
        return tracked.imitation.env(worlds, auto_reset=False, threads=1, help_scale=0.0)

    zero = torch.zeros(1, dtype=torch.long)
    rollouts, _ = run_episodes(make, tracker.policy, zero, zero, cycles=1)
    assert score_rollouts(rollouts).mpjpe_mm == tracked.evaluation.card.mpjpe_mm


def test_a_policy_without_its_critic_acts_without_lookahead(tracker: Tracker) -> None:
    blind = replace(tracker, value=None)
    done = track(walk(0, 20), blind, TrackConfig(count=2))
    assert done.controller == "policy" and NO_CRITIC in done.notes
    with refused("critic-missing"):
        look_ahead(blind, done.imitation, LookaheadConfig())
    with refused("unknown-choice", says="policy"):
        track(walk(0, 20), tracker, controller="polcy")
    assert LookaheadConfig().budget == 192.0


def test_what_cannot_be_tracked(tracker: Tracker, pointed: Tracker) -> None:
    with refused("wrong-type", says="3"):
        track(3, tracker)  # type: ignore[arg-type]
    with refused("clip-too-short"):
        track(walk(0, 2), tracker, controller="policy")
    chain = Skeleton(("a", "b", "c"), (-1, 0, 1), np.array([[0, 0, 0], [0, 0, 1.0], [0, 0, 1.0]]))
    rot = np.tile([1.0, 0, 0, 0], (10, 3, 1))
    with refused("role-missing"):
        track(Clip(chain, np.zeros((10, 3)), rot, 30.0, "chain"), tracker)
    mixed = replace(tracker, policy=pointed.policy)
    for resets in (False, True):
        with refused("policy-unfit"):
            track(walk(0, 20), mixed, reset_on_fail=resets)


def test_a_joint_beyond_its_range_is_no_blow(tracker: Tracker) -> None:
    """A character set down outside a joint's range must not be thrown back into it."""
    clip = walk(0, 40)
    knee = clip.skeleton.index("LeftLeg")
    turned = quat_mul(
        torch.tensor(clip.rot[:, knee]), torch.tensor([math.cos(0.8), 0.0, -math.sin(0.8), 0.0])
    )
    rot = np.array(clip.rot)
    rot[:, knee] = turned.numpy()
    bent = clip.replaced(rot=rot)
    # Absolute targets are shares of the ranges, which must stay as they were trained.
    assert tracker.config.action == "absolute"
    placed = place(bent, tracker)
    assert imitation_of(tracker, [placed]).humanoid is tracker.humanoid
    assert any("beyond the range" in n and "widened" not in n for n in placed.notes)
    tracker = replace(tracker, config=replace(tracker.config, action="additive"))
    placed = place(bent, tracker)
    body = imitation_of(tracker, [placed]).humanoid
    ranges = body.model.jnt_range[1:]
    assert (placed.qpos[:, 7:] >= ranges[:, 0]).all() and (placed.qpos[:, 7:] <= ranges[:, 1]).all()
    assert any("which is widened" in n for n in placed.notes)
    assert imitation_of(tracker, [place(clip, tracker)]).humanoid is tracker.humanoid


def test_a_hand_leads_as_far_as_it_is_allowed(tracker: Tracker) -> None:
    """What a policy loses, a strong hand does with it; a weak one gives no more than it may."""
    clip = shorter()
    alone, weak, strong = (
        track(clip, tracker, controller="policy", supports="none", help_limit=n)
        for n in (0.0, 5.0, 2000.0)
    )
    assert alone.card.help.limit_n == 0.0 == alone.card.help.force_mean_n
    assert not [n for n in alone.notes if n.startswith("Helped")]
    assert weak.card.help.limit_n == 5.0 and 0.0 < weak.card.help.force_p95_n <= 5.0 * (1 + 1e-5)
    assert strong.card.mpjpe_global_mm < alone.card.mpjpe_global_mm
    (said,) = [n for n in strong.notes if n.startswith("Helped")]
    assert strong.tracker.policy.num_actions == tracker.policy.num_actions
    assert "up to 2000 N" in said and "of the body's weight" in said
    ahead = track(
        clip,
        tracker,
        controller="lookahead",
        supports="none",
        help_limit=50.0,
        lookahead=LookaheadConfig(candidates=4, smoothing=(0.0,)),
        threads=1,
    )
    assert 0.0 < ahead.card.help.force_p95_n <= 50.0 * (1 + 1e-5)
    with refused("single-character-only", says="help is for a single character"):
        TrackConfig(help_limit=10.0, count=2)
