"""What test-time adaptation is tuned by in the benchmark of in-betweening."""

from __future__ import annotations

import torch

from benchmarks.suites.inbetween_complete import best_setting, choose_iterations
from poise.learn.inbetween_model import Adaptation, make_net
from toy_windows import SMALL, bank, known, layout


def test_iterations_are_chosen_by_their_score() -> None:
    of = bank()
    net, k = make_net("transformer", layout(of), SMALL, 0), known(of, dtype=torch.float32)
    scores = iter([3.0, 2.0, 1.0, 2.5, 4.0])
    best, tried = choose_iterations(net, k, 12, lambda filled: next(scores), Adaptation(), most=4)
    assert best == 2 and tried == (3.0, 2.0, 1.0, 2.5, 4.0)
    settings = [Adaptation(lr=1e-5), Adaptation(lr=1e-4)]
    results = {1e-5: (1, (0.9, 0.7)), 1e-4: (0, (0.5, 0.8))}
    chosen = best_setting(settings, lambda s: results[s.lr])
    assert chosen.lr == 1e-4 and chosen.iterations == 0
