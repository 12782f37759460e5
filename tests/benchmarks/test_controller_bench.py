"""Figures of the imitation controller: transitions from clip to clip."""

from __future__ import annotations

import torch

from benchmarks.suites.papers_compliant import changes


def test_a_transition_lasts_and_lies_within_an_episode() -> None:
    labels = torch.tensor([[0, 0, 0, 1, 0, 0, 1, 1, 1, 2, 2, 2], [0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1]]).T
    ended = torch.zeros_like(labels, dtype=torch.bool)
    # A single frame of another clip is none.
    assert changes(labels, ended, 2).tolist() == [2.0, 1.0]
    # A new episode begins at another clip without having gone there.
    ended[5, 1] = True
    assert changes(labels, ended, 2).tolist() == [2.0, 0.0]
