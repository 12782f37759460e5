"""The report page: complete, self-contained, escaped, and at rest with whatever is missing."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
import stat
from pathlib import Path

import numpy as np
import pytest
from fake_report import make_report, score
from markupsafe import escape

from poise.score.report.data import Shape, Track, foot_bodies, hold_finite, payload, safe_json
from poise.score.report.page import render, write_report
from refusals import refused

FRAMES = 40


def _motion(page: str) -> dict:
    found = re.search(r'<script type="application/json" id="motion">(.*?)</script>', page, re.S)
    assert found
    return json.loads(found[1])


def _decoded(data: dict, bodies: int) -> Track:
    """The track that `encode_track` wrote, as the page's script reads it."""
    root = np.frombuffer(base64.b64decode(data["root"]), "<f4").reshape(-1, 1, 3).astype(np.float64)
    offset = np.frombuffer(base64.b64decode(data["offset"]), "<i2").reshape(len(root), bodies, 3)
    quat = np.frombuffer(base64.b64decode(data["quat"]), "<i2").reshape(len(root), bodies, 4)
    unit = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    return Track(data["name"], root + offset * data["step"], unit)


def test_page_has_every_section_and_figure():
    page = render(make_report(FRAMES))
    for name in ("verdict", "replay", "plots", "score", "notes", "facts", "stage", "strip", "speed"):
        assert f'id="{name}"' in page
    for text in (
        "Error per frame",
        "Help per frame",
        "Learning curve",
        "Reward per term",
        "Clip itself",
    ):
        assert text in page
    assert page.count("<figure") == 4 and page.count('<svg class="pp"') == 4
    assert "{{" not in re.sub(r"<script>.*?</script>", "", page, flags=re.S)


def test_a_cost_in_units_of_its_own_is_named_and_does_not_flatten_the_bars_of_the_reward():
    terms = {"total": 0.9, "pose": 0.8, "energy <b>": 716.12}
    page = render(make_report(41, score={**score(), "reward": terms}))
    assert "Weighted total: 0.900. Not drawn: energy &lt;b&gt; 716.1." in page
    bars = page[page.index('aria-label="Reward per term"') :].split("</svg>")[0]
    assert "pose" in bars and "energy" not in bars and "716" not in bars
    page = render(make_report(41, score={**score(), "reward": {"total": 3.0, "speed": 3.0}}))
    assert "Not drawn" not in page and "speed" in page


def test_where_a_motion_is_lost_is_said_and_marked():
    page = render(make_report(41, lost=(0.5, 1.2, 9.0)))
    assert '<span class="lost">Lost at 0.5 s, 1.2 s.</span>' in page
    assert '"lost":[0.5,1.2]' in page and "where it is lost" in page
    page = render(make_report(400, lost=tuple(k / 10 for k in range(1, 11))))
    assert "0.8 s and 2 more times." in page
    assert '<span class="lost">' not in render(make_report(41))


def test_forces_at_their_points_and_others_in_the_world():
    plain = make_report(FRAMES)
    rows = tuple(np.arange(6.0 * k).reshape(k, 6) for k in (0, 2, 1))
    helps = rows + (np.zeros((0, 6)),) * (FRAMES - 3)
    data = _motion(
        render(dataclasses.replace(plain, helps=helps, others=(plain.reference, plain.simulated)))
    )
    got = np.frombuffer(base64.b64decode(data["helps"]["rows"]), "<f4").reshape(-1, 6)
    np.testing.assert_array_equal(got, np.concatenate(rows))
    first = np.frombuffer(base64.b64decode(data["helps"]["first"]), "<f4")
    assert first[:4].tolist() == [0, 0, 2, 3] and len(first) == FRAMES + 1
    assert len(data["others"]) == 2
    other = _decoded(data["others"][1], len(plain.bodies))
    np.testing.assert_allclose(other.pos, plain.simulated.pos, atol=1e-3)
    assert _motion(render(plain))["helps"] is None
    short = dataclasses.replace(plain.reference, pos=plain.reference.pos[:5])
    with refused("wrong-shape"):
        dataclasses.replace(plain, others=(short,))


def test_page_loads_nothing_from_outside():
    page = render(make_report(FRAMES))
    assert set(re.findall(r"https?://[^\s\"'`)]+", page)) <= {
        "http://www.w3.org/2000/svg",
        "http://www.w3.org/1999/xhtml",
    }
    assert not re.search(
        r"<(link|iframe|img|object)\b|\bsrc=|@import|url\(",
        re.sub(r"<script>.*?</script>", "", page, flags=re.S),
    )
    assert "default-src 'none'" in page
    assert "The MIT License" in page and "three.js authors" in page


def test_ten_seconds_stay_below_half_a_megabyte():
    assert len(safe_json(payload(make_report(300, 30.0)))) < 300_000
    assert len(safe_json(payload(make_report(600, 60.0)))) < 500_000


@pytest.mark.parametrize("away", [0.0, 500.0])
def test_motion_survives_the_round_trip(away: float):
    report = make_report(FRAMES)
    far = dataclasses.replace(report.simulated, pos=report.simulated.pos + np.array([away, -away, 0.0]))
    report = dataclasses.replace(report, simulated=far)
    data = _motion(render(report))
    for name in ("reference", "simulated"):
        track = getattr(report, name)
        back = _decoded(data[name], len(report.bodies))
        assert np.abs(back.pos - track.pos).max() < 5e-4
        assert np.abs(np.abs((back.quat * track.quat).sum(-1)) - 1).max() < 1e-7
    assert data["frames"] == FRAMES and data["fps"] == 30.0
    assert [s["kind"] for s in data["shapes"]] == [s.kind for s in report.shapes]


def test_what_comes_from_outside_is_escaped():
    evil = "</script><script>alert('x')</script>\"'><b>&amp;{{three}}"
    report = make_report(
        FRAMES,
        title=evil,
        subtitle=evil,
        notes=(evil,),
        facts={evil: evil},
        bodies=(evil, *make_report(FRAMES).bodies[1:]),
        curve={},
        score={**score(), "succ_rule": evil, evil: evil, "reward": {evil: 0.4}},
    )
    report = dataclasses.replace(report, reference=dataclasses.replace(report.reference, name=evil))
    page = render(report)
    assert "<script>alert" not in page and "<b>&amp;" not in page
    assert page.count("</script>") == 3
    assert page.count(str(escape(evil))) >= 8
    assert _motion(page)["bodies"][0] == evil


def test_optional_parts_may_be_missing():
    report = make_report(
        FRAMES, force=None, torque=None, contacts=None, score={}, curve={}, notes=(), facts={}
    )
    page = render(report)
    for text in ("No residual force was recorded", "No learning curve", "No reward was recorded"):
        assert text in page
    assert "Nothing was guessed or repaired" in page and "not measured" in page
    assert "Not fully judged" in page and "nan" not in re.sub(
        r"<script.*?</script>", "", page, flags=re.S
    )
    data = _motion(page)
    assert data["force"] is None and data["contacts"] is None and data["weight"] is None


def test_shapes_and_a_single_frame_may_be_few():
    page = render(make_report(1, shapes=(Shape(0, "sphere", (0.1, 0, 0)),)))
    assert _motion(page)["frames"] == 1


@pytest.mark.parametrize(
    "curve",
    [
        {"reward": [0.1]},
        {"reward": [1, 2], "seconds": [3, 4]},
        {"reward": [1, 2, np.nan], "samples": [0, 9, 20], "seconds": [0, 4e3, 9e3]},
        {"reward": [np.nan, np.nan]},
        {"reward": [1, 2], "samples": [5]},
    ],
)
def test_curves_of_any_columns(curve: dict):
    page = render(make_report(FRAMES, curve={k: np.array(v, dtype=float) for k, v in curve.items()}))
    assert ("No learning curve" in page) == bool(np.isnan(curve["reward"][0]))


def test_values_that_are_not_finite():
    report = make_report(FRAMES)
    pos, error = report.simulated.pos.copy(), report.error_mm.copy()
    pos[7:9, 3], error[5], force = np.nan, np.inf, np.full((FRAMES, 3), np.nan)
    report = dataclasses.replace(
        report,
        simulated=Track("Simulation", pos, report.simulated.quat),
        error_mm=error,
        force=force,
        score={**score(), "mpjpe_mm": float("nan"), "jerk": float("inf")},
    )
    page = render(report)
    back = _decoded(_motion(page)["simulated"], len(report.bodies))
    assert np.abs(back.pos[8] - pos[6]).max() < 5e-4
    assert "2 frames of &#39;Simulation&#39; had values that are not finite" in page
    assert "joint error not measured" in page
    assert (
        safe_json({"a": float("nan"), "b": [np.float32("inf"), np.int64(3)]})
        == '{"a":null,"b":[null,3]}'
    )


def test_all_frames_lost_still_give_a_page():
    array, count = hold_finite(np.full((4, 2, 3), np.nan))
    assert count == 4 and not array.any()


def test_writing_is_atomic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "new" / "report.html"
    write_report(make_report(FRAMES), path)
    before = path.read_text()
    assert before.startswith("<!doctype html>") and stat.S_IMODE(path.stat().st_mode) & 0o400

    def broken(self: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", broken)
    with refused("cannot-write"):
        write_report(make_report(FRAMES, title="other"), path)
    assert path.read_text() == before
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]


def test_wrong_shapes_are_told():
    with refused("wrong-shape", says=("error_mm", "40", "39")):
        make_report(FRAMES, error_mm=np.zeros(39))
    with refused("unknown-shape", says="cone"):
        make_report(FRAMES, shapes=(Shape(0, "cone", (1, 1, 1)),))
    with refused("index-outside", says=("99", "13")):
        make_report(FRAMES, shapes=(Shape(99, "sphere", (1, 0, 0)),))
    with refused("rate-out-of-range"):
        make_report(FRAMES, fps=0.0)


def test_feet_are_found_by_name():
    assert foot_bodies(("Hips", "LeftFoot", "RightFoot", "LeftToe", "lowerback")) == ((1, 3), (2,))
    assert foot_bodies(("L_Ankle", "R_Ankle", "toe_l", "toe.r", "head")) == ((0, 2), (1, 3))
    assert foot_bodies(("lfoot", "rfoot", "lhand")) == ((0,), (1,))
