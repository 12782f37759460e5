"""The share of a movement that is left, by frequency."""

from __future__ import annotations

import math

import pytest
import torch

from poise.metrics import detail, deviations


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


def test_the_spell_that_physics_changed_most_is_told_by_body_and_time():
    ref = torch.zeros(60, 4, 3)
    ref[:, 1:, 0] = 0.3
    pos = ref.clone()
    pos[:, 1:, 1] += 0.01
    # Body 2 is 0.2 m off for 0.3 s; body 3 for a single frame; the root's own way does not count.
    pos[12:21, 2, 2] = 0.2
    pos[40, 3, 2] = 0.5
    pos = pos + torch.linspace(0.0, 1.0, 60)[:, None, None]
    (one,) = deviations(pos, ref, 30.0)
    assert one.told(("hips", "a", "left_foot", "b"))["body"] == "left_foot"
    assert (one.start_s, one.stop_s) == pytest.approx((0.4, 0.7))
    assert one.most_mm == pytest.approx(200.2, abs=0.1)
    assert deviations(ref, ref, 30.0) == []
    # The largest three, in the order of time.
    many = ref.clone()
    for k, size in enumerate((0.1, 0.3, 0.2, 0.4)):
        many[10 * k + 5 : 10 * k + 10, 1, 2] = size
    assert [round(d.most_mm) for d in deviations(many, ref, 30.0)] == [300, 200, 400]
