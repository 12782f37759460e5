"""The benchmark of lookahead: what goes wrong in it, its figures, going on where it was stopped."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lookahead import main
from lookahead_figures import (
    budget,
    decision,
    jerk_ratio,
    mean,
    median,
    share,
    slides_as_source,
    stands_as_source,
    success,
)
from lookahead_measure import EVERY, FIRST, LASTS, Delayed, Pushed, beside, planners
from lookahead_sets import CONDITIONS, Condition, budgets_of, disturbed
from lookahead_text import MARK, put_into, tables

from poise.formats import read_clip, write_clip
from poise.motion import trim
from poise.recipes import ResidualForce, build
from poise.recipes.imitation import Imitation
from refusals import refused
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


def test_how_far_an_episode_is_from_the_motion_without_noise() -> None:
    ref = torch.zeros(1, 4, 2, 3)
    pos = ref.clone()
    pos[..., 0] = 0.1
    truth = torch.full((4, 2, 3), 0.0)
    truth[..., 1] = 0.3
    found = beside(SimpleNamespace(pos=pos, ref_pos=ref), truth)  # type: ignore[arg-type]
    assert found["true_whole"] and found["noise_mm"] == pytest.approx(300.0)
    assert found["true_error_mm"] == pytest.approx(1000 * math.hypot(0.1, 0.3), abs=1e-3)
    assert found["true_root_error_mm"] == 0


def test_budgets_by_copies_and_horizon_or_by_steps() -> None:
    found = budgets_of(["16x8", "192"])
    assert list(found) == ["16x8", "64x12"] and found["16x8"].budget == 32
    with refused("option-malformed", says="much"):
        budgets_of(["much"])
    with refused("budget-too-small"):
        budgets_of(["2x8"])


# --- figures --------------------------------------------------------------------------------------


def row(clip: str, controller: str, whole: tuple[bool, ...], budget: str = "", **more: Any) -> dict:
    episodes = [
        {
            "start": k, "whole": w, "part": 1.0 if w else 0.5, "error_mm": 50.0 + k,
            "error_uncut_mm": 50.0 + k if w else 800.0,
            "root_error_mm": 30.0, "root_error_uncut_mm": 40.0,
            "acc": 8.0, "vel": 10.0, "jerk": 150.0, "source_jerk": 100.0, "slide": 60.0,
            "source_slide": 30.0, "penetration": 1.0, "source_penetration": 2.0, "floating": 0.0,
            "source_floating": 0.0, "stance_ratio": 0.95,
        }
        for k, w in enumerate(whole)
    ]  # fmt: skip
    known = {
        "set": "cmu",
        "clip": clip,
        "controller": controller,
        "budget": budget,
        "condition": "none",
        "made_with": "this",
    }
    return known | {"starts": len(whole), "episodes": episodes} | more


def test_shares_spread_over_starts_and_medians_are_of_whole_episodes() -> None:
    rows = [row("a", "policy", (True, True)), row("b", "policy", (True, False))]
    # Of the first starts both clips are done, of the second ones a half.
    assert success(rows) == (0.75, pytest.approx(0.5 / 2**0.5))
    assert median(rows, "error_mm") == 50.0 and median(rows, jerk_ratio) == 1.5
    assert mean(rows, "error_uncut_mm") == pytest.approx((50 + 51 + 50 + 800) / 4)
    assert share(rows, slides_as_source) == 0.0 and share(rows, stands_as_source) == 1.0
    assert math.isnan(median([row("c", "policy", (False,))], "error_mm"))


def test_decisions_of_all_rows_are_one_pool() -> None:
    rows = [row("a", "lookahead", (True,), "9x9", decision_ms=[10] * 60), row("b", "lookahead", (True,),
            "9x9", decision_ms=[30] * 40)]  # fmt: skip
    assert decision(rows) == (10, 30)


def test_a_budget_curve_is_of_the_clips_that_all_budgets_were_tried_with() -> None:
    rows = [row(c, "policy", (True,)) for c in "ab"]
    rows += [row(c, "lookahead", (True,), "16x8", steps_per_step=32.0) for c in "ab"]
    assert budget(rows) == []
    rows += [row("a", "lookahead", (True,), "64x12", steps_per_step=192.0)]
    found = budget(rows)
    assert [(name, len(g)) for name, g in found] == [
        ("policy", 1), ("lookahead 16x8", 1), ("lookahead 64x12", 1),
    ]  # fmt: skip
    assert "| lookahead 16x8 | 32 | 100 % |" in tables(rows)


def test_a_table_of_what_goes_wrong_holds_clips_that_met_all_of_it(tmp_path: Path) -> None:
    pushed = {"condition": "pushes"}
    rows = [row("a", "policy", (True,)), row("b", "policy", (True,))]
    rows += [row("a", "policy", (False,)) | pushed, row("a", "lookahead", (True,), "16x8") | pushed]
    text = tables(rows)
    assert "1 clips." in text and "| pushes | 0 % |" in text
    page = tmp_path / "page.md"
    page.write_text(f"Before.\n\n{MARK}\nold\n{MARK}\n\nAfter.\n")
    put_into(page, text)
    said = page.read_text()
    assert said.startswith("Before.") and said.endswith("After.\n") and "old" not in said
    assert "| pushes |" in said


# --- the whole ------------------------------------------------------------------------------------


def test_a_benchmark_that_was_stopped_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder = tmp_path / "data/other/bandai_bvh"
    folder.mkdir(parents=True)
    write_clip(trim(read_clip(WALK), 0, 30), folder / "walk.bvh")
    out = tmp_path / "found.json"
    given = ["--data", str(tmp_path / "data"), "--json", str(out), "--set", "bandai", "--workers", "1"]
    main([*given, "--controllers", "nothing", "policy", "--starts", "2"])
    first = json.loads(out.read_text())
    assert [r["controller"] for r in first["rows"]] == ["nothing", "policy"]
    assert [e["start"] for e in first["rows"][1]["episodes"]] == [0, 1]
    one, two = first["rows"][1]["episodes"]
    assert one["whole"] and one["error_mm"] != two["error_mm"]
    assert "2 to measure, 0 rows" in capsys.readouterr().out
    main([*given, "--budgets", "10x4", "--starts", "2", "--conditions", "none", "delay"])
    assert "4 to measure, 2 rows" in capsys.readouterr().out
    rows = json.loads(out.read_text())["rows"]
    assert rows[:2] == first["rows"] and len(rows) == 6
    ahead = next(r for r in rows if r["controller"] == "lookahead" and r["condition"] == "none")
    assert 0 < ahead["steps_per_step"] <= 10 and min(ahead["decision_ms"]) > 0
    assert "What goes wrong" in out.with_suffix(".md").read_text()
    # What other settings of lookahead gave is measured anew, in its place.
    found = json.loads(out.read_text())
    ahead = next(r for r in found["rows"] if r["controller"] == "lookahead")
    ahead["made_with"] = "others"
    out.write_text(json.dumps(found))
    assert "Of lookahead's 2 rows 1 are of other settings" in tables(found["rows"])
    main([*given, "--budgets", "10x4", "--starts", "2"])
    assert "1 to measure, 6 rows" in capsys.readouterr().out
    again = json.loads(out.read_text())["rows"]
    assert len(again) == 6 and len({r["made_with"] for r in again}) == 2
    # Other draws are measured anew, of lookahead alone; with ten copies at five shares none is drawn.
    main([*given, "--budgets", "10x4", "--starts", "2", "--seed", "7"])
    assert "1 to measure, 6 rows" in capsys.readouterr().out
    drawn = json.loads(out.read_text())["rows"][-1]
    same = next(r for r in again if r["controller"] == "lookahead" and r["condition"] == "none")
    assert drawn["made_with"] != same["made_with"] and drawn["episodes"][0]["error_mm"] > 0
    main([*given, "--budgets", "10x4", "--starts", "2", "--jerk-price", "2"])
    dear = json.loads(out.read_text())["rows"][-1]
    assert len({x["made_with"] for x in (dear, drawn, same)}) == 3
