"""The model card is made of results alone, and says what is missing."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

from field.model_card import model_card

from refusals import refused

ABOUT: dict[str, Any] = {
    "clips": 12, "minutes_of_motion": 3.5, "subjects": ["cmu 02", "cmu 07"], "stage": "composer",
    "finished": True, "help_n": 0.0, "samples": 1_234_567, "seconds": 7200.0, "hardware": "2 cores",
    "primitives": 3, "policy": "abcd", "policy_numbers": 1000,
    "config": {"goal": "rotations", "seed": 4, "sim": {"control_hz": 30.0}},
    "body": {"bodies": 20, "hinges": 32, "mass_kg": 70.0, "height_m": 1.7, "identity": "ef01"},
}  # fmt: skip
ERRORS = {"g_mpjpe": 40.0, "mpjpe": 30.0, "pa_mpjpe": 20.0, "acc": 5.0, "vel": 6.0}


def table(data: str) -> dict[str, Any]:
    clips = [
        {"clip": f"{data}-{k}", "episodes": 1, "failed": k, "first_fail_s": None if not k else 1.5,
         "start": 0, "frames": 10, "errors": ERRORS}
        for k in (1, 0)
    ]  # fmt: skip
    views = dict.fromkeys(("all_frame", "all_clip", "succ_frame", "succ_clip"), ERRORS)
    whole = {"method": "ours", "data": data, "rule": "phc", "fps": 30.0, "episodes": 2, "frames": 20}
    return whole | {"succ": 0.5, "views": views, "clips": clips}


def measured() -> dict[str, Any]:
    shares = {"trials": 1000, "within": [0.9, 0.95], "learned": True}
    one = {"ms": 1.5, "phases_ms": {"policy": 0.4, "physics": 0.2, "observation": 0.9}}
    crowds = [{"characters": n, "threads": 2, "hz": 200.0} for n in (1, 16)]
    return {
        "about": deepcopy(ABOUT),
        "table": {"held_out": table("held"), "library": table("lib"), "held_out_subjects": ["cmu 35"]},
        "search": {"library": {"table": table("lib"), "found": 3, "searched": 4, "characters": 512}},
        "recovery": {"kinds": {"fallen": shares}},
        "noise": {"rungs": []},
        "noisy": {"table": table("noisy")},
        "speed": {"one": one, "crowds": crowds},
        "curves": {"stages": [{"stage": "primitive 1", "from_samples": 0}]},
    }


def test_the_card_says_what_was_measured() -> None:
    said = model_card(measured(), {"CMU": "free, credit mocap.cs.cmu.edu"}, "tracker.svg", "A tracker")
    for words in (
        "# A tracker", "3 primitives and their composer", "Body `ef01`: 20 rigid bodies, 32 hinges",
        "12 clips, 3.5 minutes, of cmu 02, cmu 07", "Held out of the training: cmu 35.",
        "| CMU | free, credit mocap.cs.cmu.edu |", "1,234,567 control steps in 2.00 hours on: 2 cores.",
        "![Learning curves](tracker.svg)", "| ours | held |", "| PHC (PHC table 1) | AMASS-Test | 140 |",
        "Recovery, fallen: 90.0 % and 95.0 % back in 5 and 10 s, 1000 trials (PHC: 95.0 and 98.8 %).",
        "- Searched, lib: 50.0 % of 2 clips, 40 mm. 3 of the 4 that it loses alone were found by 512",
        "1.50 ms a control step",
        "16 characters in one world on 2 threads: 200 Hz", "1 of 2 held-out clips fail: held-1.",
    ):  # fmt: skip
        assert words in said, words
    assert "Not measured" not in said and "not finished" not in said and "to get up" not in said
    assert "UHC" not in said


def test_what_is_missing_is_named() -> None:
    parts = measured()
    said = model_card({"about": parts["about"]})
    for words in (
        "Licences of the data: not stated.", "Held out of the training: nothing was measured",
        "Not measured: table, search, recovery, noise, noisy, speed, curves.",
        "on clips that it never saw was not measured", "did not learn to get up",
    ):  # fmt: skip
        assert words in said, words
    assert "Learning curves" not in said
    with refused("argument-missing"):
        model_card({})


def test_an_unfinished_training_says_so() -> None:
    parts = measured()
    parts["about"] |= {"finished": False, "help_n": 40.0, "primitives": 0, "stage": "single"}
    parts["about"]["config"] |= {"goal": "keypoints", "shapes": {"count": 8}}
    parts["recovery"]["kinds"]["fallen"]["learned"] = False
    said = model_card(parts)
    for words in ("**The training is not finished.**", "one network", "body places alone",
                  "helped by up to 40 N", "did not learn to get up", "Trained on 8 bodies"):  # fmt: skip
        assert words in said, words


def test_figures_that_were_skipped_are_not_measured() -> None:
    parts = measured()
    parts["noisy"] = {"skipped": "no file could be tracked", "refused": []}
    said = model_card(parts)
    assert "Not measured: noisy." in said and "real pose estimators" not in said
