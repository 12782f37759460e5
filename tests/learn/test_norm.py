"""The running normaliser against NumPy."""

import math

import numpy as np
import torch

from poise.learn.networks import RunningNorm


def stream(batches: int = 5) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    scale = torch.tensor([1.0, 100.0, 1e-2])
    return [torch.randn(7 + b, 3, generator=g) * scale + 50 * b for b in range(batches)]


def test_statistics_equal_numpy_over_all_samples():
    norm = RunningNorm(3)
    for x in stream():
        norm.observe(x)
    everything = torch.cat(stream()).double().numpy()
    np.testing.assert_allclose(norm.mean.numpy(), everything.mean(0), rtol=1e-12)
    np.testing.assert_allclose((norm.m2 / norm.count).numpy(), everything.var(0), rtol=1e-12)
    norm.freeze()
    y = norm(torch.cat(stream()).double())
    want = ((everything - everything.mean(0)) / everything.std(0)).clip(-5, 5)
    np.testing.assert_allclose(y.numpy(), want, rtol=1e-5, atol=1e-5)


def test_a_large_offset_does_not_cancel():
    x = (
        torch.randn(1000, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 1e-3
        + 1e5
    )
    norm = RunningNorm(1)
    for part in x.split(10):
        norm.observe(part)
    np.testing.assert_allclose(float(norm.m2 / norm.count), x.numpy().var(), rtol=1e-6)


def test_the_function_changes_only_at_freeze():
    norm, x = RunningNorm(3), torch.tensor([[0.5, -7.0, 2.0]])
    assert torch.equal(norm(x), torch.tensor([[0.5, -5.0, 2.0]]))
    norm.freeze()
    assert torch.equal(norm(x), torch.tensor([[0.5, -5.0, 2.0]]))
    norm.observe(stream()[0])
    assert torch.equal(norm(x), torch.tensor([[0.5, -5.0, 2.0]]))
    norm.freeze()
    assert not torch.equal(norm(x), torch.tensor([[0.5, -5.0, 2.0]]))


def test_a_constant_entry_is_only_shifted():
    norm = RunningNorm(1)
    norm.observe(torch.full((9, 1), 3.0))
    norm.freeze()
    assert norm(torch.tensor([[3.0], [3.25]])).tolist() == [[0.0], [0.25]]


def test_inverse_undoes_forward():
    norm = RunningNorm(3, clip=math.inf)
    norm.observe(stream()[0])
    norm.freeze()
    torch.testing.assert_close(norm.inverse(norm(stream()[0])), stream()[0])


def test_a_window_forgets():
    forgetful, total = RunningNorm(1, window=100), RunningNorm(1)
    for value in [0.0] * 10 + [1.0] * 10:
        x = torch.full((50, 1), value)
        forgetful.observe(x)
        total.observe(x)
    assert float(total.mean) == 0.5
    assert float(forgetful.mean) > 0.95
    assert float(forgetful.count) == 100


def test_resume_gives_identical_numbers():
    through, first, second = RunningNorm(3), RunningNorm(3), RunningNorm(3)
    for x in stream():
        through.observe(x)
        through.freeze()
    for x in stream()[:2]:
        first.observe(x)
        first.freeze()
    second.load_state_dict(first.state_dict())
    for x in stream()[2:]:
        second.observe(x)
        second.freeze()
    for name, value in through.state_dict().items():
        assert torch.equal(value, second.state_dict()[name]), name
