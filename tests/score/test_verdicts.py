"""The table of a score card and its stated thresholds."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from poise.score import THRESHOLDS, Help, ScoreCard, Threshold, table


def card(**changes):
    made = ScoreCard(
        succ=0.9, succ_rule="phc", mpjpe_mm=30.0, mpjpe_global_mm=100.0, vel_mm_per_frame=30.0,
        acc_mm_per_frame2=7.0, foot_slide_mm_per_s=50.0, penetration_mm=5.1, float_mm=math.nan,
        jerk=200.0, reward={"total": 0.8}, help=Help(100.0, 100.0, 15.0, 20.0, 10.0, 12.0, 5.0, 0.05),
        seconds=1.0, samples=1, seed=0, reference={"foot_slide_mm_per_s": 120.0, "jerk": 100.0},
    )  # fmt: skip
    return replace(made, **changes)


def test_rows_and_verdicts():
    rows = {label: (value, unit, verdict) for label, value, unit, verdict in table(card())}
    assert rows["Success (phc)"] == (90.0, "%", "fair")
    assert rows["Joint error, root-relative"] == (30.0, "mm", "good")
    assert rows["Joint error, global"][2] == "fair"
    assert rows["Velocity error"][2] == "poor"
    assert rows["Acceleration error"][2] == "good"
    assert rows["Foot slide"][2] == "good" and rows["Foot slide, reference"] == (120.0, "mm/s", "")
    assert rows["Penetration"][2] == "fair"
    assert rows["Floating"][2] == "" and "Floating, reference" not in rows
    assert rows["Jerk"][2] == "fair"  # twice the reference's
    assert rows["Help, share of body weight"] == (5.0, "%", "fair")
    assert rows["Help, mean torque"][2] == "fair"
    assert rows["Reward per step"][0] == 0.8


def test_no_help_is_good_and_torque_alone_is_not_free():
    none = Help(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    rows = {row[0]: row[3] for row in table(card(help=none))}
    assert rows["Help, share of body weight"] == rows["Help, mean torque"] == "good"
    rows = {row[0]: row[3] for row in table(card(help=replace(none, torque_mean_nm=60.0)))}
    assert rows["Help, mean torque"] == "poor"


@pytest.mark.parametrize("key", sorted(THRESHOLDS))
def test_verdicts_are_ordered_and_documented(key):
    t = THRESHOLDS[key]
    assert (t.good > t.fair) == t.more
    middle = (t.good + t.fair) / 2
    worse = t.fair - 1e-6 if t.more else t.fair + 1e-6
    verdicts = [t.verdict(x) for x in (t.good, middle, t.fair, worse, math.nan)]
    assert verdicts == ["good", "fair", "fair", "poor", ""]
    page = Path(__file__).parents[2] / "docs" / "python.md"
    assert f"| `{key}` | {t.good:g} | {t.fair:g} |" in page.read_text(encoding="utf-8")


def test_thresholds_are_frozen():
    with pytest.raises(AttributeError):
        THRESHOLDS["succ"].good = 0.1  # type: ignore[misc]
    assert Threshold(1.0, 2.0).verdict(-5.0) == "good"


def test_every_key_is_documented():
    page = (Path(__file__).parents[2] / "docs" / "python.md").read_text(encoding="utf-8")
    found = card().to_dict()
    keys = [*found, *(f"help.{k}" for k in found["help"])]
    assert [k for k in keys if k != "help" and f"`{k}`" not in page] == []


def test_figures_of_a_lost_motion_are_not_called_good():
    lost = card(succ=0.0, per_clip=({"clip": "flip", "episodes": 1},))
    rows = {row[0]: row[3] for row in table(lost)}
    assert rows["Joint error, root-relative"] == rows["Foot slide"] == rows["Jerk"] == ""
    assert rows["Velocity error"] == "poor" and rows["Success (phc)"] == "poor"
    many = card(succ=0.0, per_clip=({"clip": "flip", "episodes": 30},))
    assert {row[0]: row[3] for row in table(many)}["Joint error, root-relative"] == "good"
