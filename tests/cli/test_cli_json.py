"""`--json` of every verb: one document of one schema, alone on stdout."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any

import pytest
from tiny_clips import MINIATURE

import poise
from poise.cli import demo
from poise.cli.console import Answer, document
from poise.cli.main import VERBS, main
from poise.cli.parse import options_of
from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from poise.motion import trim
from poise.settings import plain
from sparing import spare
from toy_policy import WALK, toy_run

#: No lookahead.
ALONE = ("--controller", "policy")
KEYS = ("poise", "verb", "ok", "exit_code", "inputs", "outputs", "notes", "result", "error")


def check(found: dict[str, Any]) -> None:
    """The schema of docs/cli.md."""
    assert tuple(found) == KEYS and found["poise"] == poise.__version__ and found["verb"] in VERBS
    assert isinstance(found["exit_code"], int) and found["ok"] == (found["exit_code"] == 0)
    for path in (*found["inputs"], *found["outputs"].values()):
        assert isinstance(path, str) and Path(path).exists()
    assert all(isinstance(n, str) for n in found["notes"]) and all(map(str.isidentifier, KEYS))
    if found["error"] is not None:
        assert tuple(found["error"]) == ("code", "what", "where", "hint") and found["error"]["what"]
        assert re.fullmatch(r"[a-z]+(-[a-z]+)*", found["error"]["code"])


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("short") / "short.bvh"
    write_clip(trim(read_clip(WALK), 0, 30), path)
    return path


def lines(verb: str, short: Path, clip: Path, trained: Path, out: Path) -> tuple[list[Any], int]:
    """A command line of the verb that needs seconds, and its exit code."""
    few = ("--iterations", "1", "--envs", "16", "--threads", "1")
    if verb == "track":
        policy = toy_run(out / "policy")
        more = ["--save-policy", out / "p.safetensors", "--controller", "policy"]
        return [short, "--policy", policy, "-o", out / "o", *more], 3
    if verb == "complete":
        policy = toy_run(out / "policy")
        more = ["--adapt", "0", "--controller", "policy", "--policy", policy, "-o", out / "o"]
        return [short, "--keyframes", "0 20", *more], 3
    given: dict[str, list[Any]] = {
        "demo": ["-o", out / "o", "--iterations", "1", "--threads", "1"],
        "info": [short],
        "convert": [short, out / "o.bvh"],
        "retarget": [short, "--onto", WALK, "-o", out / "o.bvh"],
        "body": [clip],
        "imitate": [clip, "-o", out / "o", *MINIATURE],
        "train": ["residual-force", clip, "-o", out / "o", *few],
        "inbetween": [short, "--keyframes", "0 20", "-o", out / "o.bvh", "--adapt", "0"],
        "fleet": [clip, "-o", out / "o", "--set", "iterations=1", "--set", "envs=16"],
        "eval": [trained],
        "play": [trained, "-o", out / "o.html"],
        "doctor": [short, "--fix", "-o", out / "o.bvh"],
        "dream": ["--seconds", "0.3", *ALONE, "--threads", "1", "--seed-clip", short, "-o", out / "o"],
        "push": [WALK, "--force", "20", "--seconds", "0.1", *ALONE, "-o", out / "o"],
        "open": [short, "--seconds", "1", "--port", "0", "--no-browser", "-o", out / "o"],
        "live": [short, "--seconds", "1", "--port", "0", "--record", "-o", out / "o.bvh"],
    }
    return given[verb], 0


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_answers_in_one_schema(
    verb: str, short: Path, clip: Path, trained: Path, tmp_path: Path, answered: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    values = [short if value == demo.WALK else value for value in demo.run.__defaults__ or ()]
    monkeypatch.setattr(demo.run, "__defaults__", tuple(values))
    spare(monkeypatch)
    argv, code = lines(verb, short, clip, trained, tmp_path)
    found = answered(verb, *argv, code=code)
    check(found)
    assert found["error"] is None and isinstance(found["result"], dict)
    assert len(found["inputs"]) >= 1 and bool(found["outputs"]) == (verb not in ("info", "body", "eval"))


@pytest.mark.parametrize("verb", VERBS)
def test_errors_are_documents_too(verb: str, tmp_path: Path, answered: Callable[..., Any]) -> None:
    found = answered(verb, "--no-such-option", code=2)
    check(found)
    assert f"poise {verb} --help" in found["error"]["hint"] and found["result"] is None
    if verb not in ("train", "inbetween", "complete", "retarget", "doctor", "dream", "demo"):
        writes = ("imitate", "track", "push", "convert", "fleet")
        more = ["-o", tmp_path / "o.bvh"] if verb in writes else []
        found = answered(verb, tmp_path / "absent.bvh", *more, code=2)
        assert found["inputs"] == [str(tmp_path / "absent.bvh")]
        assert "absent.bvh" in found["error"]["where"]


def test_faults_and_unknown_verbs(
    short: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, answered
) -> None:
    assert main(["trak", "--json"]) == 2
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["code"] == "unknown-verb" and "'trak'" in error["what"]

    def broken(*_: object, **__: object) -> None:
        print("a library prints")
        raise ZeroDivisionError

    monkeypatch.setattr("poise.formats.read_clip", broken)
    found = answered("info", short, code=1)
    assert "ZeroDivisionError" in found["error"]["what"] and found["error"]["code"] == "internal-fault"


def test_numbers_that_are_not_finite_are_null() -> None:
    assert plain({"a": (float("nan"), Path("x"), [float("inf"), 1])}) == {"a": [None, "x", [None, 1]]}
    check(document("info", [], Answer(exit_code=2), PoiseError("wrong", "here", code="wrong-type")))


def test_the_page_documents_every_key_and_verb() -> None:
    page = (Path(__file__).parents[2] / "docs" / "cli.md").read_text("utf-8")
    assert tuple(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE)[: len(KEYS)]) == KEYS
    for verb in VERBS:
        assert (
            "json" in signature(options_of(import_module(f"poise.cli.{verb}"))).parameters
            and f"`{verb}`" in page
        )


def test_live_says_on_stderr_where_the_page_is(short: Path, tmp_path: Path, capfd) -> None:
    argv = [
        "live",
        str(short),
        "--seconds",
        "0.2",
        "--port",
        "0",
        "-o",
        str(tmp_path / "o.bvh"),
        "--json",
    ]
    assert main(argv) == 0
    out, err = capfd.readouterr()
    assert re.search(r"Poise live: http://127\.0\.0\.1:\d+", err) and "Poise live:" not in out
    check(json.loads(out))
