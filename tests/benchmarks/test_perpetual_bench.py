"""What `benchmarks/perpetual.py` says of toy runs: its parts, its resuming, its refusals."""

from __future__ import annotations

import importlib
import json
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import pytest
import torch

from poise.formats import write_clip
from poise.jobs.perpetual import perpetual_run
from poise.jobs.perpetual.evaluation import evaluate_clips
from poise.learn import ConvergenceConfig, Until
from poise.learn.composer import Composer
from poise.motion import ClipLibrary
from poise.papers.perpetual.ablations import StagedPerpetual
from poise.recipes.body_shapes import BodyShapes, shaped
from poise.recipes.perpetual import build, task
from refusals import refused
from toy_policy import PPO, toy_run, walk

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def load(name: str) -> ModuleType:
    """A module of the scripts' folder, which is no package."""
    if str(BENCHMARKS) not in sys.path:
        sys.path.append(str(BENCHMARKS))
    return importlib.import_module(name)


measure, curves, text, script = (
    load(n) for n in ("perpetual_measure", "perpetual_curves", "perpetual_text", "perpetual")
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toy_run(tmp_path_factory.mktemp("toy"))


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the two clips of the run and one that it does not know."""
    folder = tmp_path_factory.mktemp("clips") / "toy"
    folder.mkdir()
    for clip in (walk(0, 30, "first"), walk(25, 60, "second"), walk(40, 75, "third")):
        write_clip(clip, folder / f"{clip.name}.bvh")
    return folder


@pytest.fixture(scope="module")
def composed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with two primitives and a composer."""
    folder = tmp_path_factory.mktemp("composed")
    plain = {"num_envs": 8, "evaluate_every": 1, "seed": 1, "expert": False, "style": None, "ppo": PPO}
    sizes = {"max_primitives": 2, "composer_hidden": (8,), "composer_clone": False}
    config = StagedPerpetual(**(plain | sizes), convergence=ConvergenceConfig(patience=1))  # type: ignore[arg-type]
    library = ClipLibrary.of([walk(0, 30, "first"), walk(25, 60, "second")])
    imitation = perpetual_run.begin(folder, library, config)
    perpetual_run.train(imitation, folder, Until(iterations=8), threads=1, tensorboard=False)
    return folder


def test_every_part_of_one_run(run: Path, clips: Path, tmp_path: Path, capsys) -> None:
    out, card = tmp_path / "p.json", tmp_path / "card/tracker.md"
    few = [
        "--trials",
        "4",
        "--characters",
        "16",
        "--noise-clips",
        "1",
        "--strengths",
        "0",
        "1",
        "--steps",
        "5",
        "--count",
        "2",
    ]
    script.main(
        ["--runs", f"toy={run}", "--clips", str(clips), "--noisy", str(clips), *few, "-o", str(out),
         "--hardware", "a toy machine", "--card", str(card), "--licence", "toy=none needed"]
    )  # fmt: skip
    (name, parts), *more = json.loads(out.read_text())["runs"].items()
    assert name == "toy" and not more and set(script.PARTS) < {*parts, "noisy"}
    held = parts["table"]["held_out"]
    assert [c["clip"] for c in held["clips"]] == ["toy-third"]
    # The table's success is the evaluation's of the training.
    opened = measure.Run.open("toy", run)
    results = evaluate_clips(opened.imitation, opened.policy, threads=1)
    assert parts["table"]["library"]["succ"] == pytest.approx(results.rate)
    assert {parts["table"][f"{k}_nothing"]["method"] for k in ("library", "held_out")} == {"nothing"}
    # What is searched is all that is lost alone; the toy falls everywhere.
    for part, count in ((parts["search"]["held_out"], 1), (parts["search"]["library"], 2)):
        rows = part["per_clip"]
        assert part["alone"] == 0 and part["searched"] == len(rows) == count
        assert part["table"]["succ"] == part["found"] / count and part["seconds_of_a_second"] > 0
        assert all(0 < r["reached"] <= r["steps"] and r["tries"] > 0 for r in rows)
    kinds = parts["recovery"]["kinds"]
    assert set(kinds) == {"fallen", "far", "fallen and far"}
    assert {k["trials"] for k in kinds.values()} == {4} and not kinds["far"]["learned"]
    assert "no composer" in parts["owners"]["skipped"]
    assert [r["name"] for r in parts["noise"]["rungs"]] == ["clean", "all x1"]
    assert parts["noise"]["clips"] == ["toy-third"] and len(parts["noisy"]["files"]) == 3
    assert [c["characters"] for c in parts["speed"]["crowds"]] == [1, 2, 2]
    assert parts["about"]["samples"] == 3 * 8 * 4 and parts["about"]["hardware"] == "a toy machine"
    # Three iterations end before the first evaluation of a stage is due, but the last is always made.
    assert parts["curves"]["stages"] == [{"stage": "single", "from_samples": 0}]
    markdown = out.with_suffix(".md").read_text()
    for words in ("| PHC (PHC table 1) | AMASS-Test", "Not the paper's data", "never trained to recover",
                  "Held out: toy.", "Real time", "a toy machine",
                  "of the other 2 were found by 16"):  # fmt: skip
        assert words in markdown, words
    assert str(tmp_path) not in markdown and str(run) not in markdown
    written = card.read_text()
    assert "| toy | none needed |" in written and "toy-third" in written
    assert "](tracker.svg)" in written and card.with_suffix(".svg").exists()
    ElementTree.parse(card.with_suffix(".svg"))
    ElementTree.parse(tmp_path / parts["curves"]["image"])


def test_parts_stay_and_recovery_goes_on(run: Path, tmp_path: Path, monkeypatch) -> None:
    out, asked = tmp_path / "p.json", []

    def trials(_: Any, kind: str, count: int, threads: int) -> dict[str, Any]:
        if kind == "far" and asked.count("far") == 0:
            asked.append(kind)
            raise KeyboardInterrupt
        asked.append(kind)
        row = {"kind": kind, "trials": count, "within": [0.5, 1.0], "median": 2.0, "slowest": 9.0}
        return {"rows": [row], "near": 0.5, "held": 0.5, "seed": 1, "learned": True}

    monkeypatch.setattr(script, "recovery", trials)
    words = ["--runs", f"toy={run}", "-o", str(out), "--trials", "7"]
    with pytest.raises(KeyboardInterrupt):
        script.main([*words, "--parts", "curves", "recovery"])
    script.main([*words, "--parts", "recovery"])
    assert asked == ["fallen", "far", "far", "fallen and far"]
    parts = json.loads(out.read_text())["runs"]["toy"]
    assert "curves" in parts and len(parts["recovery"]["kinds"]) == 3
    script.main([*words, "--parts", "recovery"])
    assert len(asked) == 4
    script.main([*words[:-1], "8", "--parts", "recovery"])
    assert len(asked) == 7
    # Results of another policy are not kept.
    kept = json.loads(out.read_text())
    kept["runs"]["toy"]["about"]["policy"] = "another"
    out.write_text(json.dumps(kept))
    script.main([*words, "--parts", "curves"])
    assert set(json.loads(out.read_text())["runs"]["toy"]) == {"about", "curves"}


def test_what_was_learned_is_not_held_out(run: Path, clips: Path, tmp_path: Path) -> None:
    opened = measure.Run.open("toy", run)

    def held(*patterns: str) -> tuple[str, ...]:
        return measure.held_out(opened, clips, patterns, (), None, lambda _: None)[0].names

    assert held() == held("third") == ("toy-third",)
    with refused("clip-was-learned", says=("toy-first", "first")):
        held("first")
    with refused("none-held-out"):
        held("fourth")
    with refused("not-a-run"):
        measure.Run.open("x", tmp_path)


def test_held_out_clips_do_not_change_the_body(run: Path, clips: Path) -> None:
    opened = measure.Run.open("toy", run)
    found, _ = measure.held_out(opened, clips, (), (), None, lambda _: None)
    task = measure.library_task(opened, found)
    assert task.humanoid is opened.tracker.humanoid and len(task.reference.length) == 1
    small = measure.table(task, opened.policy, "held-out", "toy", 1)
    assert small.frames <= int(task.reference.length[0]) - 1


def test_tables_in_parts_are_those_of_the_whole(run: Path, monkeypatch) -> None:
    opened = measure.Run.open("toy", run)
    whole = measure.table(opened.imitation, opened.policy, "library", "toy", 1).to_dict()
    monkeypatch.setattr(measure, "AT_ONCE", 1)
    apart = measure.table(opened.imitation, opened.policy, "library", "toy", 1).to_dict()
    assert [c["clip"] for c in apart["clips"]] == [c["clip"] for c in whole["clips"]]
    for view in ("all_frame", "all_clip"):
        assert apart["views"][view] == pytest.approx(whole["views"][view], rel=1e-4)


def test_composer_and_primitives_are_compared_by_their_own_evaluations(composed: Path) -> None:
    opened = measure.Run.open("toy", composed)
    assert isinstance(opened.policy.policy, Composer) and opened.owner is not None
    result = measure.owners(opened, 1)
    whole = evaluate_clips(opened.imitation, opened.policy, threads=1)
    for c, row in enumerate(result["per_clip"]):
        assert row["composer_mm"] == round(float(whole.global_mm[c]), 2)
        assert row["owner"] == int(opened.owner[c]) + 1
        assert (row["best_succeeded"], -row["best_mm"]) >= (row["owner_succeeded"], -row["owner_mm"])
    assert sum(s["clips"] for s in result["summary"]) == 2


def row(clip: str, owner: int, own: bool, best: bool, composer: bool, mm: float) -> dict[str, Any]:
    return {
        "clip": clip, "owner": owner, "owner_succeeded": own, "owner_mm": 30.0, "best": 1,
        "best_succeeded": best, "best_mm": 20.0, "composer_succeeded": composer, "composer_mm": mm,
    }  # fmt: skip


def test_what_the_composer_loses() -> None:
    rows = [
        row("a", 1, True, True, True, 34.0),
        row("b", 1, True, True, False, 90.0),
        row("c", 1, True, True, True, 28.0),
        row("d", 2, False, True, True, 25.0),
        row("e", 2, False, False, False, 99.0),
    ]
    first, second = measure.owner_summary(rows)
    assert (first["clips"], first["owner"], first["best"], first["composer"]) == (3, 3, 3, 2)
    # (4 - 2) / 2 against the owner, (14 + 8) / 2 against the best.
    assert first["lost"] == ["b"] and first["worse_mm"] == 1.0 and first["worse_best_mm"] == 11.0
    assert (second["owner"], second["best"], second["composer"]) == (0, 1, 1)
    assert second["lost"] == [] and second["worse_mm"] is None and second["worse_best_mm"] == 5.0
    said = "\n".join(text._owners({"summary": [first, second], "per_clip": rows}))
    assert "1 clips that a primitive does, the composer does not: b." in said


LOG = """iteration,samples,stage,env/help/limit_n,time/seconds,\
eval/clips,eval/succeeded,eval/mpjpe_global_mm
1,100,1,100.0,1.0,,,
2,200,1,50.0,2.0,4,1,150.0
3,300,2,25.0,3.0,,,
4,400,2,0.0,4.0,3,2,80.0
5,500,3,0.0,5.0,4,4,40.0
6,600,3,0.0,6.
"""


@pytest.fixture
def logged(tmp_path: Path) -> Path:
    (tmp_path / "log.csv").write_text(LOG)
    told = "iteration,stage,help_n,clip\n2,primitive 1,50,a\n4,primitive 2,0,a\n5,composer,0,a\n"
    (tmp_path / "success.csv").write_text(told + "6,final,0,a\n")
    return tmp_path


def test_curves_by_stage(logged: Path) -> None:
    curve = curves.read_curve(logged)
    # The last line is half written.
    assert curve["samples"] == 500
    assert curve["stages"] == [
        {"stage": "primitive 1", "from_samples": 0},
        {"stage": "primitive 2", "from_samples": 200},
        {"stage": "composer", "from_samples": 400},
    ]
    got = [(r["samples"], r["clips"], r["succeeded"], r["help_n"]) for r in curve["evaluations"]]
    assert got == [(200, 4, 1, 50.0), (400, 3, 2, 0.0), (500, 4, 4, 0.0)]
    path = logged / "curve.svg"
    curves.draw("toy", curve, path)
    root = ElementTree.parse(path).getroot()
    panels = [e for e in root if e.tag.endswith("svg")]
    assert [p.get("y") for p in panels] == ["0", "300", "600"]
    curves.draw_runs({"a": curve, "b": curve}, path)
    ElementTree.parse(path)
    # What was known of all four clips by then.
    assert curves.at_samples(curve, 450, 4)["samples"] == 200
    assert curves.at_samples(curve, 500, 4)["succeeded"] == 4
    assert curves.at_samples(curve, 100, 4) is None
    with refused("file-missing"):
        curves.read_curve(logged / "nowhere")


def test_curves_by_source(logged: Path) -> None:
    rows = ["iteration,stage,help_n,clip,succeeded"]
    rows += [f"{i},one,0,{c},{int(i > n)}" for i in (2, 4, 5) for n, c in enumerate(
        ("humanoid3d_kick", "salsa-03", "humanoid3d_walk", "bandai_bvh-bow"), 1)]  # fmt: skip
    (logged / "success.csv").write_text("\n".join([*rows, "5,final,0,salsa-03,0"]) + "\n")
    curve = curves.read_curve(logged)
    first, _, last = (r["sources"] for r in curve["evaluations"])
    assert first == {"DeepMimic": (1, 2), "Bandai": (0, 1), "CMU, dances": (0, 1)}
    assert last == {"DeepMimic": (2, 2), "Bandai": (1, 1), "CMU, dances": (1, 1)}
    curves.draw("toy", curve, logged / "curve.svg")
    assert "success by source" in (logged / "curve.svg").read_text()
    said = "\n".join(text._curves(curve | {"image": "x.svg"}))
    assert "| 200 | 1 of 2 | 0 of 1 | 0 of 1 |" in said and "| 500 | 2 of 2 | 1 of 1 | 1 of 1 |" in said


def test_a_stage_of_recovery_has_trials_in_place_of_clips(logged: Path) -> None:
    text_ = LOG.replace("mpjpe_global_mm\n", "mpjpe_global_mm,eval/trials,eval/recovered\n")
    lines = [x + ",," if k else x for k, x in enumerate(text_.splitlines())]
    lines[4] = "4,400,2,0.0,4.0,,,,96,24"
    lines[5] = "5,500,3,0.0,5.0,4,4,40.0,96,48"
    (logged / "log.csv").write_text("\n".join(lines[:6]) + "\n")
    curve = curves.read_curve(logged)
    assert [s["stage"] for s in curve["stages"]] == ["primitive 1", "recovery", "composer"]
    told = [(r["name"], r["trials"], r["recovered"]) for r in curve["recoveries"]]
    assert told == [("recovery", 96, 24), ("composer", 96, 48)]
    said = "\n".join(text._curves(curve | {"image": "x.svg"}))
    assert "| recovery | 200 | 1 | - | - | - | - | 96 | 24 |" in said
    assert "| composer | 400 | 1 | 4 | 4 | 40 | 0 | 96 | 48 |" in said
    curves.draw("toy", curve, logged / "curve.svg")
    assert "back from falls" in (logged / "curve.svg").read_text()


def test_runs_side_by_side(logged: Path, run: Path, composed: Path, tmp_path: Path) -> None:
    out = tmp_path / "p.json"
    script.main(["--runs", f"one={run}", f"two={composed}", "--parts", "curves", "-o", str(out)])
    assert (tmp_path / "p_runs.svg").exists()
    said = out.with_suffix(".md").read_text()
    assert "## Side by side" in said and "| all clips at 96 samples |" in said
    assert "The runs had different samples, by up to a factor of 2.67" in said
    runs = json.loads(out.read_text())["runs"]
    runs["two"]["about"]["samples"] = 97
    assert "the same samples to within 2 %" in text.side_by_side(runs)


def test_a_library_on_several_bodies_is_told_body_by_body(run: Path) -> None:
    opened = measure.Run.open("toy", run)
    config = replace(opened.imitation.config, shape=True)
    plain = build(opened.imitation.library, config)
    several = shaped(plain, BodyShapes(count=2, seed=1), lambda body: task(config, body))
    trainer = several.trainer(threads=1)
    whole = measure.table(several, trainer.policy(), "library", "toy", 1)
    trainer.env.close()
    assert measure.by_body(opened.imitation, whole) == []
    first, second = measure.by_body(several, whole)
    assert (first["body"], first["clips"], second["clips"]) == (0, 2, 2)
    assert first["mass_kg"] != second["mass_kg"]
    both = (first["succ"] + second["succ"]) / 2
    assert both == pytest.approx(whole.succ)
    said = text._table({"library": whole.to_dict(), "bodies": [first, second]})
    assert "The library body by body:" in said


def test_the_mark_is_the_policys(run: Path) -> None:
    opened = measure.Run.open("toy", run)
    again = measure.Run.open("toy", run)
    assert opened.mark == again.mark
    other = opened.policy.copy()
    state = {k: v + 1e-3 if v.is_floating_point() else v for k, v in other.state().items()}
    other.load_state(state)
    assert replace(opened, tracker=replace(opened.tracker, policy=other)).mark != opened.mark


def test_a_command_without_what_is_this_machines_alone() -> None:
    words = ["--runs", "a=/srv/runs/a", "--clips", "/srv/cmu", "--hold-out", "cmu 02"]
    assert script._plain(words) == "--runs a=a --clips cmu --hold-out 'cmu 02'"
    assert shlex.split(script._plain(["--title", "a teacher's"])) == ["--title", "a teacher's"]
    with refused("option-malformed", says="cmu"):
        script._licences(["cmu"])
    assert torch.get_num_threads() == 1
