"""Training of in-betweening networks: windows without a loop, losses, resuming bit for bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from poise.learn.between import BetweenObjective, BetweenTraining, schedule
from poise.learn.checkpoint import load_checkpoint, save_checkpoint
from poise.learn.inbetween_model import (
    InbetweenModel,
    InbetweenTrainer,
    load_model,
    make_net,
    save_model,
    train_inbetween,
)
from poise.learn.window_sampler import Sampler
from poise.papers.skeleton2humanoid.rtn import RTNObjective, RTNTraining
from refusals import refused
from toy_windows import SMALL, SMALL_RTN, bank, data

STEPS = 12


def trainer(kind: str, seed: int = 0, steps: int = STEPS, **changes: object) -> InbetweenTrainer:
    frames = data(bank())
    sizes = SMALL if kind == "transformer" else SMALL_RTN
    net = make_net(kind, frames.layout, sizes, seed)
    drawn = Sampler(frames).draw(32, 30, torch.Generator().manual_seed(0))
    net.calibrate(drawn.root, drawn.rot, drawn.offsets)
    if kind == "transformer":
        config = BetweenTraining(batch=4, warmup=2, longest=20, usual=12, **changes)  # type: ignore
        learner = BetweenObjective(net, config, frames.std, steps)  # type: ignore[arg-type]
    else:
        config = RTNTraining(batch=4, **changes)  # type: ignore[arg-type]
        critics = torch.Generator().manual_seed(1)
        learner = RTNObjective(net, config, frames.std, steps, critics)  # type: ignore[arg-type]
    return InbetweenTrainer(learner, Sampler(frames), seed, steps, batch=4, block=4)


def test_windows_start_at_every_frame_that_leaves_room() -> None:
    frames = data(bank())
    sampler = Sampler(frames)
    # Four clips of 91 frames: 62 windows of 30 in each.
    assert sampler.count(30) == 4 * 62 and sampler.count(91) == 4 and sampler.count(92) == 0
    starts = set(sampler.order[: sampler.count(90)].tolist())
    assert starts == {0, 1, 91, 92, 182, 183, 273, 274}
    w = sampler.draw(64, 90, torch.Generator().manual_seed(0))
    assert w.root.shape == (64, 90, 3) and w.contact.shape == (64, 90, 4)
    at = sampler.at(torch.tensor([92]), 90)
    assert torch.equal(at.root[0], frames.root[92:182])
    assert torch.equal(at.offsets[0], frames.offsets[1])
    with refused("clip-too-short", says="92"):
        sampler.draw(1, 92, torch.Generator())


def test_masks_are_the_protocols_most_of_the_time_and_else_anything() -> None:
    learner = trainer("transformer").objective
    assert isinstance(learner, BetweenObjective)
    g = torch.Generator().manual_seed(0)
    masks = [learner.mask(g)[0] for _ in range(400)]
    whole = [m for m in masks if not bool(m[:10].any()) and bool(m[10:-1].all()) and not bool(m[-1])]
    assert 0.5 < len(whole) / 400 < 0.8
    lengths = {int(m.sum()) for m in masks}
    assert min(lengths) == 1 and max(lengths) == 20
    assert all(not bool(m[0]) and not bool(m[-1]) for m in masks)
    assert any(not bool(m[m.nonzero()[0, 0] : m.nonzero()[-1, 0]].all()) for m in masks)


def test_the_truth_has_no_loss_and_slides_where_contact_is_said() -> None:
    learner = trainer("transformer").objective
    assert isinstance(learner, BetweenObjective)
    frames = data(bank())
    batch = Sampler(frames).at(torch.tensor([3]), 20)
    known = torch.ones(20, dtype=torch.bool)
    known[10:19] = False
    from poise.learn.between import GapFrames
    from poise.motion.rotations import matrix_kinematics, quat_to_matrix

    mats = quat_to_matrix(batch.rot)
    truth = matrix_kinematics(frames.layout.parents, batch.offsets.unsqueeze(1), batch.root, mats)
    logits = torch.full((1, 20, 4), -30.0, requires_grad=True)
    parts = learner.parts(GapFrames(batch.root, mats, logits), truth, batch, known)
    for name in ("pos", "quat", "velocity"):
        assert float(parts[name]) == pytest.approx(0.0, abs=2e-4)
    sure = GapFrames(batch.root, mats, torch.full((1, 20, 4), 30.0, requires_grad=True))
    moved = learner.parts(sure, truth, batch, known)["slide"]
    step = torch.diff(truth[0][:, :, list(frames.layout.feet)], dim=1)[:, 9:19].norm(dim=-1)
    held = torch.ones(10, 4)
    held[9] = batch.contact[0, 19]
    assert float(moved) == pytest.approx(float((step * held).mean()), abs=2e-4)
    # Contacts only weigh: denying them must not pay.
    assert not moved.requires_grad


def test_step_sizes_rise_and_fall() -> None:
    rates = [schedule(k, 10, 110) for k in range(111)]
    assert rates[0] == pytest.approx(0.1) and rates[9] == rates[10] == pytest.approx(1.0)
    assert rates[60] == pytest.approx(0.505) and rates[110] == pytest.approx(0.01)


def test_transitions_of_the_recurrent_network_grow_longer() -> None:
    learner = trainer("rtn", steps=100).objective
    assert isinstance(learner, RTNObjective)
    assert [learner.longest(k) for k in (0, 25, 50, 99)] == [5, 18, 30, 30]


def test_losses_of_an_untrained_network_count_as_their_weights_say() -> None:
    whole = trainer("rtn")
    learner = whole.objective
    assert isinstance(learner, RTNObjective)
    stats = learner.step(whole.sampler, 0, whole.generator)
    c = learner.config
    weights = c.quat + c.pos + c.root + c.contact + c.adversarial + c.slide
    assert float(stats["loss"]) == pytest.approx(weights, rel=1e-4)
    settled = learner.scales.first.clone()
    learner.step(whole.sampler, 1, whole.generator)
    # The scales stay, and travel with the state.
    assert torch.equal(learner.scales.first, settled)
    assert torch.equal(whole.state()["module/scales/first"], settled)
    plain = trainer("rtn", equalise=False)
    stats = plain.objective.step(plain.sampler, 0, plain.generator)
    assert float(stats["loss"]) != pytest.approx(weights, rel=1e-2)


@pytest.mark.parametrize("kind", ["transformer", "rtn"])
def test_training_lowers_the_loss(kind: str) -> None:
    whole = trainer(kind, steps=30, **({"ramp": 0.01} if kind == "rtn" else {}))
    key = "pos"
    first = whole.iterate().parts[key]
    while not whole.done:
        last = whole.iterate()
    assert last.step == 30 and last.parts[key] < first


@pytest.mark.parametrize("kind", ["transformer", "rtn"])
def test_a_run_that_was_cut_goes_on_bit_for_bit(kind: str, tmp_path: Path) -> None:
    whole = trainer(kind)
    train_inbetween(whole, tmp_path / "whole", tensorboard=False)
    cut = trainer(kind)
    train_inbetween(cut, tmp_path / "cut", on_block=lambda s: s.step < 4, tensorboard=False)
    assert cut.step == 4
    again = trainer(kind, seed=0)
    stats, stopped = train_inbetween(again, tmp_path / "cut", tensorboard=False)
    assert stats is not None and stats.step == STEPS and not stopped
    a, b = whole.state(), again.state()
    assert a.keys() == b.keys()
    for name in a.keys() - {"counters"}:
        assert torch.equal(a[name], b[name]), name


def test_a_run_of_other_settings_is_refused(tmp_path: Path) -> None:
    train_inbetween(trainer("transformer", steps=4), tmp_path, tensorboard=False)
    for other in (trainer("transformer", steps=8), trainer("transformer", seed=1, steps=4)):
        with refused("settings-differ"):
            train_inbetween(other, tmp_path, tensorboard=False)


def test_validation_is_logged_and_the_last_block_saved(tmp_path: Path) -> None:
    seen = []

    def check(net: torch.nn.Module) -> dict[str, float]:
        seen.append(net)
        return {"l2p_30": 1.5}

    whole = trainer("transformer")
    train_inbetween(whole, tmp_path, validate=check, validate_every=8, tensorboard=False)
    assert len(seen) == 2 and seen[0] is whole.averaged
    assert "validation/l2p_30" in (tmp_path / "log.csv").read_text()


@pytest.mark.parametrize("kind", ["transformer", "rtn"])
def test_models_come_back_and_halves_are_close(kind: str, tmp_path: Path) -> None:
    of, whole = bank(), trainer(kind)
    net = whole.averaged
    model = InbetweenModel(kind, net, of.names, of.offsets[0].float(), 30.0, 20, 10, {"name": "toy"})  # type: ignore
    save_model(tmp_path / "model.safetensors", model)
    back = load_model(tmp_path)
    assert back.names == of.names and back.layout == model.layout and back.meta["name"] == "toy"
    assert back.net.config == model.net.config
    for a, b in zip(back.net.parameters(), net.parameters(), strict=True):
        assert torch.equal(a, b)
    save_model(tmp_path / "half.safetensors", model, half=True)
    half = load_model(tmp_path / "half.safetensors")
    assert (tmp_path / "half.safetensors").stat().st_size < 0.7 * (
        tmp_path / "model.safetensors"
    ).stat().st_size
    for a, b in zip(half.net.parameters(), net.parameters(), strict=True):
        assert a.dtype == torch.float32 and torch.allclose(a, b, atol=1e-3)
    with refused("file-missing"):
        load_model(tmp_path / "absent")


def test_windows_are_drawn_faster_and_slower_within_their_clip() -> None:
    of = bank()
    frames = data(of)
    sampler = Sampler(frames, stretch=1.5)
    plain = Sampler(frames)
    start = torch.tensor([5, 100])
    same = sampler.at(start, 20, torch.ones(2))
    for a, b in zip(same, plain.at(start, 20), strict=True):
        assert torch.allclose(a, b, atol=1e-6)
    # Twice as fast: every second frame. Half as fast: every frame, and one between.
    fast, slow = (
        sampler.at(start, 20, torch.full((2,), 2.0)),
        sampler.at(start, 39, torch.full((2,), 0.5)),
    )
    long = plain.at(start, 39)
    assert torch.allclose(fast.root, long.root[:, ::2], atol=1e-5)
    assert torch.allclose(slow.root[:, ::2], plain.at(start, 20).root, atol=1e-5)
    # No frame is taken from the next clip, however fast: the speed is what the clip has frames for.
    last = int(of.first[1]) - 12
    window = sampler.at(torch.tensor([last]), 10, torch.tensor([3.0]))
    assert torch.allclose(window.root[0, -1], frames.root[int(of.first[1]) - 1], atol=1e-5)
    drawn = sampler.draw(16, 30, torch.Generator().manual_seed(0))
    assert drawn.root.shape == (16, 30, 3) and bool(drawn.rot.norm(dim=-1).sub(1).abs().max() < 1e-5)
    with refused("out-of-range", says="stretch"):
        Sampler(frames, 0.5)


def test_a_network_of_before_speeds_were_seen_opens_as_it_was(tmp_path: Path) -> None:
    of = bank()
    net = make_net("transformer", data(of).layout, replace(SMALL, speeds=False), 0)
    path = tmp_path / "old.safetensors"
    save_model(path, InbetweenModel("transformer", net, of.names, of.offsets[0], 30.0, 20))
    tensors, meta = load_checkpoint(path)
    del meta["config"]["speeds"]
    save_checkpoint(path, tensors, meta)
    opened = load_model(path).net
    assert opened.config == net.config
    assert all(torch.equal(a, b) for a, b in zip(opened.parameters(), net.parameters(), strict=True))
