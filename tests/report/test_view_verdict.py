"""The verdict in words, its thresholds, and the score table."""

from __future__ import annotations

from dataclasses import replace

import pytest
from fake_report import make_report, score

from poise.score.report.page import amount, render, score_rows
from poise.score.report.verdict import grades, help_given, overall, percent, sentence


def test_sentence_of_a_good_run():
    assert sentence(score()) == (
        "Tracks the whole clip from every start: yes (100 %) · joint error 32 mm · "
        "help 11 N = 1.9 % of body weight"
    )
    assert overall(score()) == "good"


def test_one_episode_per_clip_is_not_every_start():
    clips = [{"clip": "walk", "episodes": 1}, {"clip": "run", "episodes": 1}]
    assert "the whole clip from its first frame: yes" in sentence(score() | {"per_clip": clips})
    clips[1]["episodes"] = 30
    assert "the whole clip from every start: yes" in sentence(score() | {"per_clip": clips})


@pytest.mark.parametrize(
    ("changes", "level"),
    [
        ({"succ": 0.96}, "good"),
        ({"succ": 0.9}, "fair"),
        ({"succ": 0.5}, "poor"),
        ({"succ": None}, "unknown"),
        ({"mpjpe_mm": 70}, "fair"),
        ({"mpjpe_mm": 120}, "poor"),
        ({"mpjpe_mm": float("nan")}, "unknown"),
        ({"mpjpe_mm": float("nan"), "succ": 0.1}, "poor"),
        ({"foot_slide_mm_per_s": 900}, "good"),
        ({"help": {"force_mean_n": 60, "share_of_body_weight": 0.09}}, "fair"),
        ({"help": {"force_mean_n": 300, "share_of_body_weight": 0.4}}, "poor"),
        ({"help": {"force_mean_n": 5}}, "unknown"),
        ({"help": {}}, "unknown"),
        ({"help": {"force_mean_n": 0.0, "share_of_body_weight": 0.0, "torque_mean_nm": 30.0}}, "poor"),
    ],
)
def test_the_worst_figure_decides(changes: dict, level: str):
    assert overall({**score(), **changes}) == level


def test_no_help_is_said_plainly():
    none = {"help": {"force_mean_n": 0.0, "share_of_body_weight": 0.0, "torque_mean_nm": 0.0}}
    assert sentence({**score(), **none}).endswith("help none")
    assert help_given(none).level == "good"


def test_thresholds_are_stated_beside_the_figures():
    assert [g.rule for g in grades(score())][:2] == [
        "good from 95, fair from 80 %",
        "good to 40, fair to 80 mm",
    ]


def test_per_cent_never_rounds_to_all_or_nothing():
    shares = (1.0, 0.9999, 0.96875, 0.5, 0.00001, 0.0)
    assert [percent(s) for s in shares] == ["100 %", "99.9 %", "96.9 %", "50 %", "below 0.1 %", "0 %"]


def test_amounts():
    assert [
        amount(1_500_000),
        amount(3.14159, "mm"),
        amount(41.26, "N"),
        amount(None),
        amount("<b>"),
    ] == [
        "1\u202f500\u202f000",
        "3.14 mm",
        "41.3 N",
        "\u2013",
        "<b>",
    ]


def test_table_shows_the_clip_beside_and_keeps_unknown_keys():
    rows = score_rows({**score(), "jerk": 900.0, "new_figure": 7.25})
    table = {row.name: row for row in rows}
    assert (*table["Foot slide"][1:3], table["Foot slide"].mark) == ("14.2 mm/s", "41 mm/s", "better")
    assert (table["Jerk"].value, table["Jerk"].mark) == ("900 m/s³", "worse")
    assert rows[-1].name == "new_figure" and rows[-1].value == "7.25"
    assert "Help: force limit" in table and score_rows({})
    page = render(make_report(40, score={**score(), "jerk": 900.0}))
    assert 'class="n better">14.2 mm/s</td><td class="n">41 mm/s' in page
    assert 'class="n worse">900 m/s³' in page


def test_the_written_motion_is_told_beside_the_simulation():
    assert grades(score())[3].detail == "the motion it follows: 41 mm/s"
    written = {"delivered": [{"clip": "walk", "delivered": {"sole_slide_mm_per_s": 5.6}}]}
    told = "the motion it follows: 41 mm/s; soles of the written motion, feet held: 6 mm/s"
    assert grades({**score(), **written})[3].detail == told
    assert grades({**score(), "delivered": [{"clip": "no feet"}]})[3].detail.endswith("41 mm/s")


def test_figures_of_a_lost_motion_are_said_to_end_at_the_loss():
    lost = {**score(), "succ": 0.0, "per_clip": [{"clip": "flip", "episodes": 1}]}
    error, slide = grades(lost)[1], grades(lost)[3]
    assert error.level == slide.level == "unknown"
    assert error.detail.startswith("only of what comes before the loss")
    assert overall(lost) == "poor"
    assert not any(row.mark == "better" for row in score_rows(lost))
    assert any(row.mark == "better" for row in score_rows(score()))
    assert "not judged" in render(replace(make_report(), score=lost))
    assert grades({**lost, "mpjpe_mm": 300.0})[1].level == "poor"
