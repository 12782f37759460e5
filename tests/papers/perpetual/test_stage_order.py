"""Which stage follows which, when each ends at the latest, and how much help it may have."""

from __future__ import annotations

import pytest

from poise.jobs.perpetual.stages import MOST, Stage, StageOrder, clone_for, order_of
from poise.learn import CloneConfig
from poise.papers.perpetual.ablations import StagedPerpetual
from poise.papers.perpetual.primitive_stages import PrimitiveOrder
from poise.recipes.perpetual_settings import Perpetual, RecoveryPlan
from refusals import refused
from toy_library import tiny


def path(config: StagedPerpetual, fails: bool = True) -> list[str]:
    """The names of all stages where clips always fail, or never."""
    order = PrimitiveOrder(config)
    stage: Stage | None = order.first
    names = []
    while stage is not None:
        names.append(stage.name)
        assert order.lasts(stage) == (order.following(stage, True) is None)
        stage = order.following(stage, fails)
    return names


def test_each_switch_has_its_stages() -> None:
    three = ["primitive 1", "primitive 2", "primitive 3"]
    assert path(StagedPerpetual()) == [*three, "recovery", "composer"]
    assert path(StagedPerpetual(), fails=False) == ["primitive 1", "recovery", "composer"]
    assert path(StagedPerpetual(recovery=False)) == [*three, "composer"]
    assert path(StagedPerpetual(recovery=False), fails=False) == ["primitive 1"]
    assert path(StagedPerpetual(max_primitives=1)) == ["primitive 1", "recovery", "composer"]
    assert path(StagedPerpetual(max_primitives=1, recovery=False)) == ["primitive 1"]
    for switch, name in (("single", "single"), ("multiplicative", "single"), ("progressive", "joint")):
        one = {switch: switch == "single"}
        assert path(StagedPerpetual(**one)) == [name, f"{name} with recovery"]
        assert path(StagedPerpetual(**one, recovery=False)) == [name]


def test_where_the_first_primitive_recovers_none_of_its_own_does() -> None:
    plan = RecoveryPlan(primitive="first", share=0.2)
    known = StagedPerpetual(recovering=plan, shares=(0.5, 0.8))
    assert path(known) == ["primitive 1", "primitive 2", "primitive 3", "composer"]
    assert path(known, fails=False) == ["primitive 1"]
    last = Stage("composer", 4, mixed=True)
    assert last.recovers == "composer" and PrimitiveOrder(known).primitives(last) == 3
    assert PrimitiveOrder(StagedPerpetual()).primitives(Stage("composer", 5, mixed=True)) == 3
    assert PrimitiveOrder(known).primitives(Stage("primitive", 2)) == 2
    assert [PrimitiveOrder(known).ends(Stage("primitive", k), 0.0) for k in (2, 3)] == pytest.approx(
        [0.65, 0.8]
    )
    with refused("settings-conflict"):
        StagedPerpetual(recovering=plan, max_primitives=1)


def test_what_recovers_is_told_by_the_stage() -> None:
    known = {s.name: s.recovers for s in (Stage("primitive", 2), Stage("recovery", 4), Stage("single"))}
    assert known == {"primitive 2": None, "recovery": "primitive", "single": None}
    assert Stage("composer", 5, mixed=True).recovers == "composer"
    assert Stage("composer", 4).recovers is None


def test_stages_end_by_shares_of_the_whole() -> None:
    plain = StagedPerpetual(recovery=False, shares=(0.5, 0.8))
    assert [PrimitiveOrder(plain).ends(Stage("primitive", k), 0.0) for k in (1, 2, 3)] == pytest.approx(
        [0.5, 0.65, 0.8]
    )
    plan = RecoveryPlan(share=0.2)
    config = StagedPerpetual(shares=(0.5, 0.8), recovering=plan)
    got = [PrimitiveOrder(config).ends(Stage("primitive", k), 0.0) for k in (1, 2, 3)]
    assert got == pytest.approx([0.4, 0.52, 0.64])
    recovery = Stage("recovery", 4)
    # After primitives that needed all their time, its share of the whole; else more in proportion.
    assert PrimitiveOrder(config).ends(recovery, 0.64) == pytest.approx(0.84)
    assert PrimitiveOrder(config).ends(recovery, 0.28) == pytest.approx(0.28 + 0.72 * 20 / 36)
    assert PrimitiveOrder(config).ends(Stage("composer", 5, mixed=True), 0.84) == 1.0
    alone = StagedPerpetual(single=True, shares=(0.5, 0.8), recovering=plan)
    assert PrimitiveOrder(alone).ends(Stage("single"), 0.0) == pytest.approx(0.64)
    assert PrimitiveOrder(alone).ends(Stage("single", 2, mixed=True), 0.64) == 1.0


def test_a_stage_is_over_by_its_decision() -> None:
    order, last = PrimitiveOrder(StagedPerpetual()), Stage("composer", 5, mixed=True)
    one = Stage("primitive")
    assert [order.is_over(one, d, 0.3) for d in ("go on", "next", "solved")] == [
        False,
        True,
        True,
    ]
    # Nothing begins where no time is left, and what is last is over when it is solved.
    assert not order.is_over(one, "next", 1.0) and not order.is_over(one, "solved", 1.0)
    assert order.is_over(last, "solved", 1.0) and not order.is_over(last, "next", 0.9)
    assert PrimitiveOrder(StagedPerpetual(recovery=False)).is_over(one, "solved", 1.0)


def test_help_ends_within_the_stage() -> None:
    config = StagedPerpetual(recovery=False, shares=(0.5, 0.8), help_share=0.8)
    shares = [
        PrimitiveOrder(config).most_help(Stage("primitive"), 0.1, s) for s in (0.1, 0.26, 0.42, 0.5)
    ]
    assert shares == pytest.approx([1.0, 0.5, 0.0, 0.0])


def test_one_network_has_the_stages_that_it_has_beside_primitives() -> None:
    plan = RecoveryPlan(share=0.2)
    for recovery in (True, False):
        one = Perpetual(recovery=recovery, recovering=plan)
        staged = StagedPerpetual(single=True, recovery=recovery, recovering=plan)
        engine, paper = order_of(one), order_of(staged)
        assert type(engine) is StageOrder and type(paper) is PrimitiveOrder
        stages = (Stage("single"), Stage("single", 2, mixed=True))
        assert engine.first == paper.first == stages[0]
        assert [engine.following(s, True) for s in stages] == [paper.following(s, True) for s in stages]
        assert [engine.ends(s, 0.1) for s in stages] == [paper.ends(s, 0.1) for s in stages]
        assert engine.ppo(stages[0]) == paper.ppo(stages[0])
        assert not engine.given_first and engine.primitives(stages[0]) == 0


def test_the_clone_grows_with_the_library() -> None:
    assert clone_for(300, 512) == CloneConfig()
    big = clone_for(31_000, 512)
    assert (big.rounds + 1) * big.steps * 512 == pytest.approx(16 * 31_000, rel=0.01)
    assert big.rounds == 5
    whole = [clone_for(n, 512) for n in (60_000, 10**6)]
    assert all((c.rounds + 1) * c.steps * 512 <= MOST + 6 * 512 for c in whole)
    assert tiny(clone=None).clone is None


def test_switches_that_exclude_each_other_are_told() -> None:
    for bad, word in (
        ({"single": True, "progressive": False}, "progressive"),
        ({"multiplicative": False, "progressive": False}, "multiplicative"),
        ({"progressive": False, "combine": "means"}, "combine='product'"),
        ({"progressive": False, "max_primitives": 1}, "2 primitives"),
        ({"shares": (0.5, 1.0)}, "shares"),
    ):
        with refused("settings-conflict", says=word):
            StagedPerpetual(**bad)
    with refused("out-of-range", says="share"):
        RecoveryPlan(share=1.0)
