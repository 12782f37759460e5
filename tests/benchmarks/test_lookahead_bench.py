"""The benchmark of lookahead: what goes wrong in it, its figures, going on where it was stopped."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from benchmarks.common.rows import Figure
from benchmarks.suites.lookahead_search import (
    CONDITIONS,
    EVERY,
    FIRST,
    LASTS,
    MEDIANS,
    Condition,
    Delayed,
    Pushed,
    disturbed,
    draws,
    figures,
    planners,
)  # fmt: skip
from poise.formats import read_clip
from poise.motion import trim
from poise.recipes import ResidualForce, build
from poise.recipes.imitation import Imitation
from toy_human import swing

WALK = Path(__file__).resolve().parents[1] / "fixtures/old/walk.bvh"


@pytest.fixture(scope="module")
def imitation() -> Imitation:
    return build(swing(), ResidualForce(num_envs=1))


# --- what goes wrong ------------------------------------------------------------------------------


def test_a_planner_that_is_wrong_leaves_the_world_as_it_is(imitation: Imitation) -> None:
    own = imitation.model
    wrong = planners(imitation, Condition(mass=1.1, friction=0.7, gains=0.9)).model
    assert wrong.body_mass.sum() == pytest.approx(1.1 * own.body_mass.sum())
    assert wrong.body_subtreemass[1] == pytest.approx(1.1 * own.body_subtreemass[1])
    assert wrong.geom_friction[0, 0] == pytest.approx(0.7 * own.geom_friction[0, 0])
    assert wrong.actuator_gainprm[0, 0] == pytest.approx(0.9 * own.actuator_gainprm[0, 0])
    assert wrong.actuator_biasprm[0, 1] == -wrong.actuator_gainprm[0, 0]
    assert wrong.dof_damping[6] == pytest.approx(0.9 * own.dof_damping[6])
    assert own.body_mass.sum() == pytest.approx(imitation.humanoid.mass)
    assert planners(imitation, Condition(push_n=150.0)) is imitation


def test_pushes_come_when_they_are_said_to(imitation: Imitation) -> None:
    worlds = Pushed(imitation.model, 1, 150.0, 3)
    felt = []
    for _ in range(FIRST + EVERY + 5):
        worlds.drive.clear()
        worlds.step(2)
        felt.append(worlds.drive.xfrc_applied[0, 1, :3].clone())
    pushed = [t for t, force in enumerate(felt) if bool(force.any())]
    assert pushed == [*range(FIRST, FIRST + LASTS), *range(FIRST + EVERY, FIRST + EVERY + LASTS)]
    one, two = felt[FIRST], felt[FIRST + EVERY]
    assert (
        float(one.norm()) == pytest.approx(150.0) and one[2] == 0 and torch.equal(one, felt[FIRST + 1])
    )
    assert not torch.allclose(one, two)
    worlds.close()


def test_a_delayed_controller_does_what_it_wanted_a_step_ago() -> None:
    late = Delayed(SimpleNamespace(act=lambda obs: 2.0 * obs))  # type: ignore[arg-type]
    assert [float(late.act(torch.tensor([x]))) for x in (1.0, 2.0, 3.0)] == [2.0, 2.0, 4.0]


def test_noise_is_seeded_and_a_low_pass_calms_it() -> None:
    clip = trim(read_clip(WALK), 0, 60)
    noisy = disturbed(clip, CONDITIONS["noise 0.5"], 1)
    again = disturbed(clip, CONDITIONS["noise 0.5"], 1)
    assert (noisy.root_pos == again.root_pos).all() and disturbed(clip, Condition(), 1) is clip
    calm = disturbed(clip, CONDITIONS["noise 0.5, smoothed"], 1)

    def shaking(c: Any) -> float:
        return float(abs(torch.tensor(c.positions()).diff(n=3, dim=0)).mean())

    assert shaking(calm) < 0.5 * shaking(noisy)


# --- figures --------------------------------------------------------------------------------------


def episode(trial: int, done: bool, error: float, **more: Any) -> dict[str, Any]:
    rest = {k: 10.0 for k in MEDIANS} | {"g_mpjpe_mm": error, "core_s_a_s": 0.5}
    won = {"phc": done, "sonic": False, "blinkmimic": True}
    return {"trial": trial, "won": won, **rest, **more}


def told(episodes: list[dict[str, Any]]) -> dict[str, Figure]:
    return {f.metric: f for f in figures(None, {"clip": {"episodes": episodes}}, "x")}  # type: ignore[arg-type]


def test_shares_spread_over_starts_and_medians_are_of_whole_episodes() -> None:
    slides = {"slide_mm_per_s": 60.0, "source_slide_mm_per_s": 30.0}
    rows = [episode(1, True, 50.0), episode(1, True, 52.0, **slides)]
    rows += [episode(2, True, 60.0), episode(2, False, 800.0, decision_ms=[10, 30], steps_a_step=3.0)]
    found = told(rows)
    # Of the first starts both are done, of the second ones a half.
    assert (
        found["done"].value == 0.75 and found["done"].spread == "0.5 to 1" and found["done"].seeds == 2
    )
    assert found["done_sonic"].value == 0 and found["done_blinkmimic"].value == 1
    assert found["median_g_mpjpe_mm"].value == 52.0
    assert found["slides_as_source"].value == pytest.approx(2 / 3)
    assert found["decision_ms_p50"].value == 30 and "0.05 rad" in found["done"].subject


def test_draws_are_a_mean_of_shares() -> None:
    def one(done: bool) -> dict[str, Any]:
        return {"episodes": [episode(0, done, 1.0)]}

    raws = {
        "a, seed 1": one(True),
        "b, seed 1": one(False),
        "a, seed 2": one(True),
        "b, seed 2": one(True),
    }
    (found,) = draws(None, raws, "x")  # type: ignore[arg-type]
    assert found.value == 0.75 and found.spread == "0.5 to 1" and found.seeds == 2
