"""Networks of the next frame: what they see in training, that they learn, and what they make."""

from __future__ import annotations

import pytest
import torch

from benchmarks.suites.papers_next_frames import (
    NextFrame,
    NextFrameConfig,
    NextFrameObjective,
    NextFrames,
)
from poise.learn.cvae import PackedFrames
from poise.learn.inbetween_model import InbetweenTrainer
from poise.synthesis.generator import ROOT
from refusals import refused

HINGES = 3
SMALL = {
    "egopose": NextFrameConfig(past=6, future=8, hidden=24, decoder=(16,)),
    "erd": NextFrameConfig(past=6, future=8, encoder=(16,), decoder=(16,), hidden=24, noise=0.05),
    "aclstm": NextFrameConfig(past=6, future=8, hidden=24, layers=2, truth=2, own=3),
}


def made(config: NextFrameConfig, seed: int = 0) -> NextFrame:
    return NextFrame(ROOT + HINGES, config, torch.Generator().manual_seed(seed))


def swinging() -> torch.Tensor:
    """Frames `(F, D)`: a body that walks on, its hinges swing."""
    t = torch.arange(400.0)[:, None]
    frames = torch.zeros(400, ROOT + HINGES)
    frames[:, 0], frames[:, 3], frames[:, 4], frames[:, 8] = 1.0, 0.9, 1.0, 1.0
    frames[:, ROOT:] = torch.sin(0.3 * t + torch.arange(HINGES))
    return frames


def test_presets_are_what_the_papers_have() -> None:
    erd, ac = NextFrameConfig.erd(), NextFrameConfig.aclstm()
    assert erd.layers == 2 and len(erd.encoder) == 2 and erd.noise > 0 and not erd.own
    assert ac.layers == 3 and ac.truth == ac.own == 5 and not ac.noise
    with refused("out-of-range"):
        NextFrameConfig(hidden=0)


def test_frames_of_its_own_stand_where_it_is_to_see_them() -> None:
    net = made(SMALL["aclstm"])
    x = torch.randn(2, 10, ROOT + HINGES, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        out = net.trained(x, torch.Generator().manual_seed(0))
        other = x.clone()
        # Frames 2 to 4 and 7 to 9 are its own, so the true ones are not looked at.
        other[:, [2, 3, 4, 7, 8, 9]] += 5.0
        assert torch.equal(net.trained(other, torch.Generator().manual_seed(0)), out)
        other[:, 5] += 1.0
        changed = net.trained(other, torch.Generator().manual_seed(0))
    assert torch.equal(changed[:, :5], out[:, :5]) and not torch.allclose(changed[:, 5], out[:, 5])


@pytest.mark.parametrize("name", SMALL)
def test_they_learn_and_go_on(name: str) -> None:
    frames = PackedFrames(swinging(), torch.tensor([0, 400]))
    net = made(SMALL[name])
    net.calibrate(frames.frames)
    trainer = InbetweenTrainer(NextFrameObjective(net, 16, 3e-3), frames, steps=150, batch=16, ema=0.0)
    first = trainer.iterate().parts["loss"]
    while not trainer.done:
        last = trainer.iterate().parts["loss"]
    assert last < 0.5 * first
    seeds = torch.zeros(2, 6, 7 + HINGES)
    seeds[..., 2], seeds[..., 3] = 0.9, 1.0
    bounds = torch.tensor([[-1.0], [1.0]]).expand(2, HINGES).double()
    maker = NextFrames(net, seeds, 30.0, bounds)
    rng = torch.Generator().manual_seed(3)
    past = maker.begin(2, rng)
    out = maker.propose(past, rng, 3)
    assert out.shape == (2, 3, 8, 7 + HINGES) and bool(out.isfinite().all())
    assert float(out[..., 7:].abs().max()) <= 1.0
    # Without noise all futures are the same.
    assert torch.allclose(out[:, 0], out[:, 1]) == (not SMALL[name].noise)
    again = maker.propose(past, torch.Generator().manual_seed(5), 3)
    assert torch.equal(again, maker.propose(past, torch.Generator().manual_seed(5), 3))
    with refused("wrong-shape", says="6"):
        NextFrames(net, seeds[:, 1:], 30.0)
