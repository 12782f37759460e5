"""The tables of the papers' claims: what counts as shown, by hand."""

from __future__ import annotations

import pytest
from perpetual_rows import judged, markdown
from rfc_order_tables import cells, comparisons, figure, write


def run(value: float) -> dict:
    curve = [[100, value, 10.0], [200, value, 20.0]]
    return {"eval_imitation": value, "return_last": 20 * value, "succ": value, "force_mean_n": 1.0} | {
        "curve": curve
    }


def test_a_difference_is_shown_where_clips_and_seeds_agree():
    clips = ("a", "b", "c", "d")
    runs = {f"{c}/deepmimic/0": run(0.5) for c in clips}
    runs |= {f"{c}/rfc-implicit/0": run(0.6 + 0.01 * k) for k, c in enumerate(clips)}
    found = {c["measure"]: c for c in comparisons(runs)}
    first = found["eval_imitation"]
    # Differences 0.10 to 0.13: mean 0.115, deviation 0.0129, standard error 0.0065.
    assert first["difference"] == pytest.approx(0.115) and first["standard_error"] == 0.0065
    assert first["higher_on"] == 4 and first["seed_spread"] is None and first["shown"]
    # Seeds that are as far apart as the methods show nothing; nor do three clips.
    again = comparisons(runs | {f"{c}/deepmimic/1": run(0.6) for c in clips})[0]
    assert again["seed_spread"] == pytest.approx(0.1) and not again["shown"]
    assert not comparisons({n: r for n, r in runs.items() if n[0] != "d"})[0]["shown"]


def test_scaled_gains_stand_apart(tmp_path):
    runs = {"a/deepmimic/0": run(0.5), "a/deepmimic/0/gains x 2": run(0.7), "b/deepmimic/0": run(0.4)}
    assert cells(runs, "succ") == {"deepmimic": {"a": [0.5], "b": [0.4]}}
    assert cells(runs, "succ", gains=True) == {
        "deepmimic": {"a, gains x 1": [0.5], "a, gains x 2": [0.7]}
    }
    assert figure(runs).count("<svg ") == 3
    write(tmp_path / "x.json", "command", runs, {"clip": "a", "ms": {"poise/deepmimic": 1.0}})
    text = (tmp_path / "x.md").read_text()
    assert (
        "| DeepMimic (no help) | 0.50 | 0.40 | 0.45 |" in text and "| poise/deepmimic | 1.00 |" in text
    )


def test_a_row_is_above_another_only_beyond_the_spread_of_seeds():
    assert judged({"plain": [0.5], "relaxed": [0.9]})["relaxed"]["verdict"] == "not shown"
    until = {"plain": [0.5, 0.52], "relaxed": [0.6, 0.62], "style": [0.6], "uhc": [0.5]}
    found = judged(until, null=0.49)
    verdicts = {name: v.get("verdict") for name, v in found.items()}
    assert verdicts == {"plain": None, "relaxed": "above", "style": "not shown", "uhc": "below"}
    assert [v["verdict_nothing"] for v in found.values()] == ["not shown", "above", "above", "not shown"]


def test_tables_name_what_each_row_is_compared_with():
    null = {"steps": {"a": 10}, "done": [], "until": 0.3, "g_mpjpe": 100.0, "acc": 5.0, "force_n": 0.0}
    rows = {f"plain-{k}": null | {"samples": 5, "until": 0.5 + k / 50} for k in range(2)}
    rows["relaxed-0"] = rows["plain-0"] | {"until": 0.6, "done": ["a"]}
    noisy = {n: r | {"noise": {"clean": r["until"]}} for n, r in rows.items()}
    text = markdown("command", rows, noisy, null)
    assert "| relaxed | 1 | 60 | 100.0 | 5.0 | 0.0 | plain +9.0 above | +30.0 above |" in text
    assert "| plain | 0, 0 | 50, 52 | 100.0, 100.0 | 5.0, 5.0 | 0.0, 0.0 |  | +21.0 above |" in text
    assert "| relaxed | 60 | plain +9.0 above |" in text and "| nothing | 0 | 30 |" in text
    assert "## Runs, 5 control steps each" in text


def test_rows_with_a_teacher_take_equal_times_not_samples():
    null = {"steps": {"a": 10}, "done": [], "until": 0.3, "g_mpjpe": 100.0, "acc": 5.0, "force_n": 0.0}
    rows = {"longer-0": null | {"samples": 900, "until": 0.6}}
    rows["taught-0"] = null | {"samples": 30, "until": 0.65}
    text = markdown("command", rows, {}, null, minutes=6)
    assert "## Runs, 6 minutes of a core each" in text
    assert "| taught | 0 | 65 | 100.0 | 5.0 | 0.0 | longer +5.0 not shown | +35.0 not shown |" in text
