"""Frames that know no place, and a kinematic policy that goes on from its own past."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from poise.env.generator_goal import GeneratorGoal
from poise.jobs.endless.endless_training import (
    Endless,
    balanced,
    motions_of,
    seeds_of,
    train_generator,
)
from poise.jobs.endless.model import GeneratorModel, Motions, load_generator
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.learn.checkpoint import load_checkpoint, save_checkpoint
from poise.learn.cvae import (
    CVAE,
    Code,
    CosineCVAE,
    CVAEConfig,
    CVAEObjective,
    CVAETraining,
    PackedFrames,
    cosines,
    falling,
    settling,
)
from poise.motion import ClipLibrary
from poise.motion.rotations import axis_angle_to_quat, quat_mul, quat_rotate
from poise.synthesis.generator import ROOT, Codes, Kinematic, coordinates, features_of
from refusals import refused
from toy_policy import walk

SMALL = CVAEConfig(past=10, future=12, latent=8, hidden=32, layers=(32,))
COSINE = CVAEConfig(past=10, future=12, latent=8, hidden=32, decoder="cosine", cosines=6)


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


@pytest.fixture(scope="module")
def motions(tracker: Tracker) -> Motions:
    return motions_of(ClipLibrary.of([walk()]), tracker, SMALL, lambda _: None)


@pytest.fixture(scope="module")
def trained(motions: Motions, tmp_path_factory: pytest.TempPathFactory) -> tuple[GeneratorModel, Path]:
    folder = tmp_path_factory.mktemp("run")
    config = Endless(SMALL, CVAETraining(batch=16), steps=60, ema=0.9)
    return train_generator(motions, folder, config)[0], folder


def moved(qpos: Tensor, yaw: float) -> Tensor:
    """A motion turned about +Z and moved along the floor."""
    q = axis_angle_to_quat(torch.tensor([0.0, 0, 1]).double(), torch.tensor(yaw).double())
    q = q.expand(len(qpos), 4)
    away = torch.tensor([3.0, -4.0, 0.0]).double()
    place = quat_rotate(q, qpos[:, :3]) + away
    return torch.cat((place, quat_mul(q, qpos[:, 3:7]), qpos[:, 7:]), 1)


def test_frames_and_coordinates_are_the_same_motion(motions: Motions) -> None:
    qpos = motions.seeds[0]
    frames = features_of(qpos, 30.0)
    assert frames.shape == (len(qpos), ROOT + qpos.shape[1] - 7)
    back = coordinates(frames[None, 1:], qpos[None, 0], 30.0)[0]
    torch.testing.assert_close(back, qpos[1:], atol=1e-9, rtol=0)
    # They know neither place nor heading.
    torch.testing.assert_close(features_of(moved(qpos, 2.0), 30.0), frames, atol=1e-9, rtol=0)


def test_windows_lie_within_clips() -> None:
    frames = PackedFrames(torch.arange(30.0)[:, None], torch.tensor([0, 20, 30]))
    assert frames.count(12) == 9
    drawn = frames.draw(200, 12, torch.Generator().manual_seed(0))[..., 0]
    assert bool((torch.diff(drawn, dim=1) == 1).all()) and set(drawn[:, 0].tolist()) == set(range(9))
    with refused("clip-too-short", says="21"):
        frames.draw(1, 21, torch.Generator())


def test_windows_are_drawn_by_weights_and_end_with_their_clip() -> None:
    frames = PackedFrames(
        torch.arange(30.0)[:, None], torch.tensor([0, 20, 30]), torch.tensor([1.0, 9.0])
    )
    starts = frames.starts(2000, 10, torch.Generator().manual_seed(0))
    # Eleven windows of weight 1, one of weight 9.
    assert abs(float((starts == 20).float().mean()) - 9 / 20) < 0.05
    assert set(starts.tolist()) == {*range(11), 20}
    assert frames.taken(torch.tensor([17, 20]), 5)[..., 0].tolist() == [
        [17, 18, 19, 19, 19], [20, 21, 22, 23, 24],
    ]  # fmt: skip


def test_labels_are_drawn_more_evenly(motions: Motions) -> None:
    windows = torch.tensor([90, 20, 10]).repeat_interleave(1)
    first = torch.cat((torch.zeros(1, dtype=torch.long), (windows + 29).cumsum(0)))
    many = replace(motions, frames=PackedFrames(torch.zeros(int(first[-1]), 3), first))
    kinds = torch.tensor([0, 1, 1])
    for balance, share in ((0.5, 3**0.5 / (1 + 3**0.5)), (1.0, 0.5)):
        even = balanced(many, kinds, Endless(replace(SMALL, past=10, future=20), balance=balance))
        starts = even.frames.starts(4000, 30, torch.Generator().manual_seed(1))
        assert float((starts < first[1]).float().mean()) == pytest.approx(share, abs=0.03)
    assert balanced(many, kinds, Endless(SMALL)) is many


def test_motions_begin_as_evenly_as_labels_are_drawn(motions: Motions) -> None:
    count = len(motions.frames.frames)
    first = torch.tensor([0, 12, count])
    frames = PackedFrames(motions.frames.frames, first)
    plain = replace(
        motions, frames=frames, clips=("one", "two"), seeds=motions.seeds[:2].repeat(8, 1, 1)
    )
    assert seeds_of(plain, SMALL)[0] is plain.seeds
    weights = torch.tensor([0.0, 1.0])
    seeds, clips = seeds_of(replace(plain, frames=PackedFrames(frames.frames, first, weights)), SMALL)
    assert seeds.shape[1:] == (SMALL.past, motions.seeds.shape[-1]) and set(clips.tolist()) == {1}
    poses = frames.frames[:, -len(motions.hinges) :].unfold(0, SMALL.past, 1).transpose(1, 2)
    apart = (poses[:, None] - seeds[None, ..., 7:].float()).abs().amax((-2, -1))
    assert float(apart.amin(0).max()) < 1e-5 and bool((apart.argmin(0) >= 12).all())


def test_a_share_is_between_none_and_all() -> None:
    with refused("out-of-range", says="balance"):
        Endless(balance=2.0)


def test_short_clips_teach_from_their_own_past_too() -> None:
    net = CosineCVAE(ROOT + 1, replace(COSINE, past=6), generator=torch.Generator().manual_seed(0))
    frames = torch.randn(60, ROOT + 1, generator=torch.Generator().manual_seed(1))
    # The first clip has room for a segment that follows half of one, not for one that follows a whole.
    sampler = PackedFrames(frames, torch.tensor([0, 25, 60]), torch.tensor([1.0, 0.001]))
    learner = CVAEObjective(net, CVAETraining(batch=8, own_past=1.0, shorter=True), 100)
    rng = torch.Generator().manual_seed(2)
    parts = [learner.step(sampler, k, rng) for k in range(12)]
    assert all(bool(p["loss"].isfinite()) for p in parts)
    assert 0 < sum("own_square" in p for p in parts) < 12


def test_divergence_and_step_sizes_by_hand() -> None:
    code = Code(torch.tensor([[1.0, 0.0]]), torch.tensor([[0.0, np.log(4.0)]]))
    assert float(code.divergence()) == pytest.approx(0.5 * (1 + 3 - np.log(4.0)))
    assert [falling(k, 100, 0.2) for k in (0, 19, 60, 100)] == pytest.approx([1, 1, 0.5, 0])


@pytest.mark.parametrize(("net", "shorter"), [(SMALL, False), (COSINE, True)])
def test_training_lowers_the_loss_and_goes_on_bit_for_bit(
    motions: Motions, tmp_path: Path, net: CVAEConfig, shorter: bool
) -> None:
    config = Endless(net, CVAETraining(batch=8, shorter=shorter), steps=100, ema=0.9)
    losses: list[float] = []
    whole, _, _ = train_generator(
        motions, tmp_path / "a", config, on_block=lambda s: losses.append(s.parts["square"])
    )
    assert losses[-1] < losses[0]
    train_generator(motions, tmp_path / "b", config, on_block=lambda s: False)
    resumed, _, _ = train_generator(motions, tmp_path / "b", config)
    same = zip(whole.net.state_dict().values(), resumed.net.state_dict().values(), strict=True)
    assert all(torch.equal(a, b) for a, b in same)
    with refused("settings-differ"):
        train_generator(motions, tmp_path / "b", Endless(net, steps=7))


def test_a_segment_begins_where_the_past_ends(
    trained: tuple[GeneratorModel, Path], tracker: Tracker
) -> None:
    made = trained[0].generator(tracker.humanoid)
    rng = torch.Generator().manual_seed(3)
    past = made.begin(4, rng)
    assert past.shape == (4, 10, tracker.humanoid.model.nq)
    assert float(past[:, -1, :2].abs().max()) == 0.0
    future = made.generate(past, torch.arange(4), rng)
    steps = torch.diff(torch.cat((past[:, -1:], future), 1), dim=1)[..., 7:].abs().amax((0, 2))
    usual = torch.diff(past, dim=1)[..., 7:].abs().max()
    assert float(steps.max()) < 3 * float(usual)
    low, high = trained[0].bounds
    assert bool(((future[..., 7:] >= low) & (future[..., 7:] <= high)).all())
    # Where a character is and which way it faces does not matter.
    z = torch.Generator().manual_seed(5)
    one = made.generate(past[:1], torch.zeros(1).long(), z)[0]
    z = torch.Generator().manual_seed(5)
    there = made.generate(moved(past[0], 1.0)[None], torch.zeros(1).long(), z)[0]
    torch.testing.assert_close(moved(one, 1.0)[:, :3], there[:, :3], atol=1e-4, rtol=0)


def test_it_is_saved_and_drives_a_goal(
    trained: tuple[GeneratorModel, Path], tracker: Tracker, tmp_path: Path
) -> None:
    model, folder = trained
    again = load_generator(folder)
    rng = torch.Generator().manual_seed(1)
    one = model.generator(tracker.humanoid).endless(30, rng)
    two = again.generator(tracker.humanoid).endless(30, torch.Generator().manual_seed(1))
    torch.testing.assert_close(one, two, atol=1e-4, rtol=0)
    assert one.shape == (40, tracker.humanoid.model.nq) and bool(one.isfinite().all())
    goal = GeneratorGoal(again.generator(tracker.humanoid), tracker.humanoid, 30.0, 2, seed=7)
    goal.reset(torch.arange(2))
    goal.aim(None, None)
    for _ in range(20):
        goal.advance(None, None)
    assert not goal.notes and bool(goal.now().isfinite().all())
    model.save(tmp_path / "half.safetensors", half=True)
    assert (tmp_path / "half.safetensors").stat().st_size < 0.7 * folder.joinpath(
        "generator.safetensors"
    ).stat().st_size


def test_what_makes_no_sense_is_refused(
    trained: tuple[GeneratorModel, Path], motions: Motions, tracker: Tracker, tmp_path: Path
) -> None:
    model, folder = trained
    with refused("out-of-range", says="temperature"):
        model.generator(tracker.humanoid, -1.0)
    with refused("wrong-shape", says="10"):
        Kinematic(model.net, motions.seeds[:, :5], 30.0)
    with refused("library-too-small", says=("90", "86")):
        motions_of(ClipLibrary.of([walk()]), tracker, CVAEConfig(), lambda _: None)
    tensors, meta = load_checkpoint(folder / "generator.safetensors")
    file = tmp_path / "bad.safetensors"
    save_checkpoint(file, {**tensors, "seeds": tensors["seeds"][:, :3]}, meta)
    with refused("file-damaged", says="seeds"):
        load_generator(file)
    save_checkpoint(file, tensors, {**meta, "kind": "tracker"})
    with refused("wrong-file-kind"):
        load_generator(file)
    other = GeneratorModel(model.net, model.seeds, model.bounds, ("a",), 30.0)
    with refused("bodies-differ"):
        other.generator(tracker.humanoid)
    with refused("out-of-range", says="past"):
        CVAEConfig(past=1)


def test_what_is_off_dies_down_and_a_clean_past_changes_nothing() -> None:
    true, future = torch.zeros(1, 4, 1), torch.zeros(1, 3, 1)
    assert torch.equal(settling(true, true, future, 2.0), future)
    # o = 1 and v = 0.5: (1 + (0.5 + 1 / 2) t) exp(-t / 2).
    past = torch.tensor([0.0, 0.0, 0.5, 1.0])[None, :, None]
    got = settling(past, true, future, 2.0)[0, :, 0]
    want = [(1 + t) * np.exp(-t / 2) for t in (1, 2, 3)]
    torch.testing.assert_close(got, torch.tensor(want).float())


def test_cosines_are_orthonormal_and_a_future_begins_as_the_past_ends() -> None:
    basis = cosines(12, 6)
    torch.testing.assert_close(basis.T @ basis, torch.eye(6), atol=1e-6, rtol=0)
    net = CosineCVAE(14, COSINE, generator=torch.Generator().manual_seed(0))
    past = torch.cumsum(torch.full((2, 10, 14), 0.1), 1)
    made = net.decode(past, torch.randn(2, 8))
    # One frame later it has gone on by the velocity, and a hundredth of what the network says.
    step = (made[:, 0] - past[:, -1]).detach()
    assert float((step - 0.1 * 4 * (1 - np.exp(-0.25))).abs().max()) < 0.05
    code = net.encode(past, made)
    assert code.mean.shape == (2, 8) and bool((code.log_var <= 2).all())


def test_codes_are_those_of_similar_pasts() -> None:
    weights = torch.tensor([1.0, 0.5])
    past = torch.randn(6, 12, 2, generator=torch.Generator().manual_seed(0))
    codes = Codes(torch.empty(0), torch.arange(6.0)[:, None], torch.full((6, 1), -20.0), weights)
    codes = replace(codes, keys=codes.key_of(past))
    torch.testing.assert_close(codes.keys[2], (past[2, [-1, -5, -12]] * weights).flatten())
    rng = torch.Generator().manual_seed(1)
    # The very past of a window: its code, at any temperature.
    assert codes.draw(past, 3, rng, 1.0).round().flatten().tolist() == [
        k for k in range(6) for _ in "abc"
    ]
    between = torch.lerp(past[:1], past[1:2], 0.49)
    drawn = codes.draw(between, 200, rng, 1.0).round().flatten().tolist()
    assert set(drawn) >= {0.0, 1.0} and min(drawn.count(0.0), drawn.count(1.0)) > 20


def test_several_futures_bend_where_the_character_walks(
    trained: tuple[GeneratorModel, Path], tracker: Tracker
) -> None:
    made = trained[0].generator(tracker.humanoid, 0.0)
    rng = torch.Generator().manual_seed(0)
    past = made.begin(2, rng)
    futures = made.propose(past, rng, 9)
    assert futures.shape == (2, 9, 12, tracker.humanoid.model.nq)
    # Two as usual, then three ways each of what followed the most similar pasts.
    ends = futures[0, :, -1, :2]
    left, straight, right = ends[2:5] - past[0, -1, :2]
    turns = [float(torch.linalg.cross(_flat(straight), _flat(x))[2]) for x in (left, right)]
    assert turns[0] * turns[1] < 0
    assert made.propose(past, rng, 1).shape[1] == 1


def _flat(x: Tensor) -> Tensor:
    return torch.cat((x, x.new_zeros(1)))


def test_wide_codes_are_those_of_the_most_similar_pasts_each_once() -> None:
    past = torch.randn(6, 12, 2, generator=torch.Generator().manual_seed(0))
    codes = Codes(torch.empty(0), torch.arange(6.0)[:, None], torch.zeros(6, 1), torch.ones(2))
    codes = replace(codes, keys=codes.key_of(past))
    z = codes.wide(past[:2], 3)[:, 0].tolist()
    assert z[0] == 0.0 and z[3] == 1.0 and len(set(z[:3])) == len(set(z[3:])) == 3
    # Where there are fewer than asked for they come again.
    assert codes.wide(past[:1], 8)[:, 0].tolist()[6:] == codes.wide(past[:1], 8)[:, 0].tolist()[:2]


def test_reach_is_larger_for_a_hip_than_for_a_wrist(motions: Motions, tracker: Tracker) -> None:
    assert motions.reach.shape == (ROOT + len(motions.hinges),) and bool((motions.reach >= 0).all())
    assert float(motions.weights.mean()) == pytest.approx(1.0, abs=1e-3)
    # The root's height moves every body by as much.
    height = motions.frames.frames[:, 3].std()
    assert float(motions.reach[3]) == pytest.approx(float(height), rel=1e-3)


def test_the_network_goes_on_from_any_number_of_frames() -> None:
    net = CVAE(14, SMALL, generator=torch.Generator().manual_seed(0))
    past, z = torch.randn(3, 10, 14), torch.randn(3, 8)
    assert net.decode(past, z, 5).shape == (3, 5, 14)
    torch.testing.assert_close(net.decode(past, z)[:, :5], net.decode(past, z, 5))
