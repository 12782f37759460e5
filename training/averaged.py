"""Averages the weights of policies that began as one: a policy between what each has learned since.

    python training/averaged.py POLICY=0.5 ANOTHER=0.5 [--critic POLICY] -o averaged.safetensors

Every number of the networks that act and of the observations' normaliser is the mean of the policies',
by their shares (Wortsman et al. 2022, "Robust fine-tuning of zero-shot models", eq. 1, and "Model
soups"). It needs no training; it needs that all were trained on from the same weights, and are of one
character, goal and kind. The critic is that of one policy, the first by default: the mean of several
serves lookahead worse. Of what else a policy's file says, its clips and settings, the first's is kept,
but for samples and seconds: those of the one that learned longest.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from poise.errors import PoiseError
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker, save_tracker
from poise.learn.checkpoint import State
from poise.learn.policy import Value


def averaged(
    trackers: Sequence[Tracker], shares: Sequence[float], critic: Tracker | None = None
) -> Tracker:
    """The first policy with the means of all their numbers.

    critic: whose critic is kept; the first's by default.

    Raises:
        PoiseError: they are of different characters or networks, or the shares make no mean.
    """
    if min(shares) < 0 or abs(sum(shares) - 1.0) > 1e-6:
        raise PoiseError(
            f"shares are no less than 0 and 1 together, not {_words(shares)}", code="bad-weights"
        )
    first = trackers[0]
    mine = first.policy.identity(first.humanoid.identity)
    for k, other in enumerate(trackers[1:], 2):
        if other.policy.identity(other.humanoid.identity) != mine:
            raise PoiseError(
                f"policy {k} is of another character or of other networks than the first",
                code="bodies-differ",
            )
    policy = first.policy.copy()
    policy.load_state(_mean([t.policy.state() for t in trackers], shares))
    told = critic or first
    value = told.value and Value(policy, told.value.state(), told.config.ppo.activation)
    longest = max(trackers, key=lambda t: t.about["samples"]).about
    about = {**first.about, **{k: longest[k] for k in ("samples", "seconds")}}
    return replace(first, policy=policy, value=value, about=about)


def _mean(states: Sequence[State], shares: Sequence[float]) -> State:
    out: State = {}
    for name, value in states[0].items():
        whole = sum(s * x[name].double() for s, x in zip(shares, states, strict=True))
        assert isinstance(whole, torch.Tensor)
        out[name] = whole.to(value.dtype) if value.is_floating_point() else value
    return out


def _words(numbers: Sequence[float]) -> str:
    return ", ".join(f"{x:g}" for x in numbers)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("policies", nargs="+", metavar="POLICY=SHARE")
    parser.add_argument(
        "--critic", metavar="POLICY", help="whose critic is kept; the first's by default"
    )
    parser.add_argument("-o", "--out", type=Path, required=True)
    a = parser.parse_args(argv)
    parts = [text.rpartition("=") for text in a.policies]
    for text, (name, _, share) in zip(a.policies, parts, strict=True):
        if not (name and share.replace(".", "", 1).isdecimal()):
            raise PoiseError(
                f"a policy with its share is POLICY=0.5, not '{text}'", code="option-malformed"
            )
    trackers = [open_run(name).tracker for name, _, _ in parts]
    critic = open_run(a.critic).tracker if a.critic else None
    save_tracker(averaged(trackers, [float(share) for _, _, share in parts], critic), a.out)


if __name__ == "__main__":
    main()
