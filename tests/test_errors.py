"""Errors carry a code that programs can trust: everywhere, and through whatever passes an error on."""

from __future__ import annotations

import ast
import copy
import pickle
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from poise.errors import PoiseError, brief
from poise.learn import TrainingError
from poise.settings import from_data
from poise.sim import SimConfig
from refusals import refused

ROOT = Path(__file__).resolve().parents[1]
KINDS = ("PoiseError", "TrainingError", "refuse")
CODE = re.compile(r"[a-z]+(-[a-z0-9]+)*")


def calls(folder: str) -> Iterator[tuple[str, ast.Call]]:
    """Each call that makes an error, with its place; scripts that run alone call `refuse` instead."""
    for path in sorted((ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            func = node.func if isinstance(node, ast.Call) else None
            if isinstance(node, ast.Call) and isinstance(func, ast.Name) and func.id in KINDS:
                yield f"{path.relative_to(ROOT)}:{node.lineno}", node


def code_of(call: ast.Call) -> ast.expr | None:
    return next((k.value for k in call.keywords if k.arg == "code"), None)


def words_in(code: ast.expr) -> list[str]:
    """The codes that an expression may give; none where it hands on the code of another error."""
    if isinstance(code, ast.IfExp):
        return words_in(code.body) + words_in(code.orelse)
    return [code.value] if isinstance(code, ast.Constant) else []


@pytest.mark.parametrize("folder", ["src/poise", "benchmarks"])
def test_every_error_has_a_code(folder: str) -> None:
    found = list(calls(folder))
    assert len(found) > (200 if folder == "src/poise" else 5)
    assert [place for place, call in found if code_of(call) is None] == []
    said = [(place, word) for place, call in found for word in words_in(code_of(call))]  # type: ignore[arg-type]
    assert [(place, word) for place, word in said if not CODE.fullmatch(word)] == []
    # One kind of mistake has one code: no two differ in a plural alone.
    one: dict[str, str] = {}
    for place, word in said:
        bare = "-".join(part.rstrip("s") for part in word.split("-"))
        assert one.setdefault(bare, word) == word, place


def test_tests_match_codes_and_no_sentences() -> None:
    raises = re.compile(r"raises\(\s*(?:poise\.)?(?:PoiseError|TrainingError|UnstableError),\s*match")
    files = [p for p in (ROOT / "tests").rglob("*.py") if raises.search(p.read_text("utf-8"))]
    assert files == []


def test_a_code_is_kept_by_whatever_passes_an_error_on(tmp_path: Path) -> None:
    error = PoiseError("has no frames", "a.bvh, line 3", "Add some", code="no-frames")
    assert str(error) == "a.bvh, line 3: has no frames. Add some"
    for again in (copy.copy(error), pickle.loads(pickle.dumps(error))):
        assert type(again) is PoiseError and str(again) == str(error)
        assert (again.code, again.what, again.where, again.hint) == (
            "no-frames",
            "has no frames",
            "a.bvh, line 3",
            "Add some",
        )
    assert brief(error, tmp_path / "a.bvh").code == "no-frames"
    hot = pickle.loads(pickle.dumps(TrainingError("x", code="training-diverged")))
    assert type(hot) is TrainingError and hot.code == "training-diverged"
    # What settings refuse by themselves is told with their file, under its own code.
    with refused("not-a-multiple", says="run.toml"):
        from_data(SimConfig, {"rate_hz": 100.0, "control_hz": 30.0}, tmp_path / "run.toml")
    kind: Any = PoiseError
    with pytest.raises(TypeError, match="code"):
        kind("an error without one")
