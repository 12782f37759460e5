"""The share of a movement that is left, by frequency."""

from __future__ import annotations

import math

import pytest
import torch

from poise.metrics import detail


def waves(*parts: tuple[float, float], seconds: float = 8.0, fps: float = 30.0) -> torch.Tensor:
    """A body beside a root that travels: a sum of (Hz, m)."""
    t = torch.arange(round(seconds * fps), dtype=torch.float64) / fps
    y = sum((a * torch.sin(2 * math.pi * hz * t) for hz, a in parts), torch.zeros_like(t))
    root = torch.stack((1.2 * t, torch.zeros_like(t), torch.ones_like(t)), -1)
    return torch.stack((root, root + torch.stack((torch.zeros_like(t), y, 0.1 * y), -1)), 1)


def test_each_band_has_the_share_of_its_energy():
    asked, made = (
        waves((1.0, 0.1), (2.0, 0.05), (4.5, 0.02)),
        waves((1.0, 0.1), (2.0, 0.025), (4.5, 0.0)),
    )
    left = detail(made, asked, 30.0)
    assert left["0.5-1.5 Hz"] == pytest.approx(1.0, abs=0.01)
    assert left["1.5-3 Hz"] == pytest.approx(0.25, abs=0.01)
    assert left["3-6 Hz"] == pytest.approx(0.0, abs=0.01)


def test_a_tremble_is_more_than_was_asked_for():
    left = detail(waves((1.0, 0.1), (5.0, 0.02)), waves((1.0, 0.1), (5.0, 0.01)), 30.0)
    assert left["3-6 Hz"] == pytest.approx(4.0, abs=0.1)


def test_what_a_clip_cannot_tell_is_left_out():
    short = waves((1.0, 0.1), seconds=1.0)
    assert "0.5-1.5 Hz" not in detail(short, short, 30.0) and "6-12 Hz" in detail(short, short, 30.0)
    assert detail(short[:3], short[:3], 30.0) == {}
    slow = waves((1.0, 0.1), fps=8.0)
    assert "6-12 Hz" not in detail(slow, slow, 8.0)
