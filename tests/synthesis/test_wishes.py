"""Wishes: characters keep to a label of the library for a while, and then turn to another one."""

from __future__ import annotations

from dataclasses import replace

import torch

from poise.env.generator_goal import GeneratorGoal
from poise.jobs.endless.model import load_generator
from poise.jobs.open import open_run
from poise.synthesis.generator import FEWEST, Codes, Wishes

SIZES = (FEWEST, FEWEST - 1, FEWEST + 4, FEWEST)


def codes() -> Codes:
    """Codes of four labels, of which the second has too few, about as many different pasts; z is the
    label."""
    kinds = torch.cat([torch.full((n,), k) for k, n in enumerate(SIZES)])
    rng = torch.Generator().manual_seed(0)
    past = kinds[:, None, None].float() + 0.01 * torch.randn(len(kinds), 12, 2, generator=rng)
    z, few = kinds[:, None].float(), torch.full((len(kinds), 1), -20.0)
    made = Codes(torch.empty(0), z, few, torch.ones(2), kinds)
    return replace(made, keys=made.key_of(past))


def test_only_codes_of_a_label_are_drawn() -> None:
    c, rng = codes(), torch.Generator().manual_seed(1)
    past, kinds = torch.zeros(2, 12, 2), torch.tensor([2, 3])
    assert c.draw(past, 5, rng, 1.0, kinds).round().flatten().tolist() == [2] * 5 + [3] * 5
    # Where there are fewer than asked for they come again, never those of another label.
    wide = c.wide(past, 2 * FEWEST, kinds).unflatten(0, (2, -1)).flatten(1)
    assert set(wide[0].tolist()) == {2.0} and set(wide[1].tolist()) == {3.0}
    near = c.apart(past, torch.tensor([0, 2]))
    assert near.shape == (2, 2) and bool((near[:, 0] < near[:, 1]).all())


def test_a_label_is_kept_to_and_then_another_one_is_wished_for() -> None:
    c, rng = codes(), torch.Generator().manual_seed(2)
    wishes = Wishes.among(c, 4.0, worlds=3)
    assert wishes is not None and wishes.labels.tolist() == [0, 2, 3]
    ids, told = torch.tensor([0, 2]), list[int]()
    for _ in range(200):
        told.append(int(wishes.next(torch.full((2, 12, 2), 1.8), ids, rng)[0]))
    runs = [len(r) for r in _runs(told)][:-1]
    assert min(runs) >= 2 and max(runs) <= 6 and set(told) == {0, 2, 3}
    assert wishes.kind[1] == -1
    # The nearest label is turned to most often.
    assert told.count(2) > max(told.count(0), told.count(3))
    assert Wishes.among(c.only(0), 4.0) is None
    assert Wishes.among(replace(c, kinds=torch.zeros_like(c.kinds)), 4.0) is None  # type: ignore[arg-type]


def _runs(told: list[int]) -> list[list[int]]:
    out = [[told[0]]]
    for one in told[1:]:
        out[-1].append(one) if one == out[-1][-1] else out.append([one])
    return out


def test_wishes_are_in_snapshots_and_the_same_by_seed() -> None:
    tracker, model = open_run(None).tracker, load_generator()
    made = model.generator(tracker.humanoid)
    assert made.wishing(0.0).wishes is None and made.wishing(0.0).rows() == {}

    def goal() -> GeneratorGoal:
        one = GeneratorGoal(made.wishing(10.0, 2), tracker.humanoid, 30.0, 2, seed=3, lead=40)
        one.reset(torch.arange(2))
        one.aim(None, None)
        return one

    a, b = goal(), goal()
    assert torch.equal(a.qpos, b.qpos) and torch.equal(
        a.generator.rows()["kind"], b.rows()["generator/kind"]
    )
    state = {k: v.clone() for k, v in a.state().items()}
    for _ in range(150):
        a.advance(None, None)
    moved = a.generator.rows()["left"].tolist()
    a.load_state(state)
    assert a.generator.rows()["left"].tolist() == b.generator.rows()["left"].tolist() != moved
    # What follows a snapshot is that again.
    for _ in range(150):
        a.advance(None, None)
        b.advance(None, None)
    assert torch.equal(a.now(), b.now())
