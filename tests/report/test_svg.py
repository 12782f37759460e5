"""Plots in text: well-formed, placed where the numbers say, safe with gaps and odd input."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from poise.score.report.svg import bar_plot, line_plot, short, ticks


@pytest.mark.parametrize(
    ("low", "high", "want"),
    [
        (0, 1, [0, 0.2, 0.4, 0.6, 0.8, 1.0]),
        (0, 10, [0, 2, 4, 6, 8, 10]),
        (-3, 3, [-3, -2, -1, 0, 1, 2, 3]),
        (1, 1, [1]),
    ],
)
def test_ticks_are_round(low: float, high: float, want: list[float]):
    assert ticks(low, high) == pytest.approx(want)


def test_ticks_of_no_range():
    assert ticks(float("nan"), 1) == []


def test_short_numbers():
    assert [short(v) for v in (0, 0.25, 1500, 12000, 1.5e6, -2e9)] == [
        "0",
        "0.25",
        "1500",
        "12k",
        "1.5M",
        "-2G",
    ]


def test_line_plot_is_well_formed_and_written(tmp_path: Path):
    x = np.arange(5.0)
    path = tmp_path / "plot.svg"
    series = [("a <b>", x, x**2), ("band", x, x, (x - 1, x + 1)), ("other", x, x, (x, x + 1))]
    axes = {"right": ("%", 2.0), "top": ("min", lambda v: v / 60)}
    text = line_plot(series, "T & co", "time (s)", "error (mm)", path, **axes)
    root = ElementTree.fromstring(text)
    assert root.tag.endswith("svg") and path.read_text() == text
    words = "".join(root.itertext())
    assert all(word in words for word in ("a <b>", "T & co", "time (s)", "error (mm)", "%", "min"))
    assert "prefers-color-scheme" in text and "data-plot" not in text


def test_line_goes_through_the_corners():
    text = line_plot([("a", [0, 10], [0, 1])], "t", "x", "y", zero=True, inline=True)
    (start, end) = re.findall(r"[ML]([\d.]+) ([\d.]+)", text)
    assert [float(v) for v in start] == [58.0, 254.0]
    # The y axis ends 6 % above the largest value.
    assert float(end[0]) == 544.0
    assert float(end[1]) == pytest.approx(254 - (254 - 12) / 1.06, abs=0.06)


def test_gaps_break_the_line():
    text = line_plot([("a", [0, 1, 2, 3], [1, np.nan, 2, 3])], "t", "x", "y", inline=True)
    path = re.search(r'class="pp-l"[^>]* d="([^"]*)"', text)
    assert path and path[1].count("M") == 2 and path[1].count("L") == 1
    assert "null" in text and "NaN" not in text


@pytest.mark.parametrize("y", [[], [1.0], [np.nan, np.nan], [2.0, 2.0], [1e12, -1e12]])
def test_odd_series_still_draw(y: list[float]):
    text = line_plot([("a", np.arange(len(y)), y)], "t", "x", "y")
    ElementTree.fromstring(text)
    assert "nan" not in text and "inf" not in text
    ElementTree.fromstring(line_plot([], "t", "x", "y"))


def test_bars_have_the_length_of_their_values():
    text = bar_plot([("half", 0.5), ("<one>", 1.0), ("none", float("nan"))], "t", "reward", most=1.0)
    ElementTree.fromstring(text)
    widths = [float(w) for w in re.findall(r'<rect x="150.0"[^>]*width="([\d.]+)"', text)]
    assert widths == [175.0, 350.0]
    assert "no value" in text and "&lt;one&gt;" in text
    ElementTree.fromstring(bar_plot([], "t", "reward"))
    ElementTree.fromstring(bar_plot([("less", -1.0), ("more", 2.0)], "t", "reward"))
