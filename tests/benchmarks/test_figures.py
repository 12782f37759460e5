"""Figures are of the policy that ships, or their page says of which."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from poise.jobs.open import open_run
from poise.papers.compliant.training import digest_of

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def digest() -> str:
    return digest_of(open_run(None).tracker.policy)


def test_cards_and_their_figures_are_of_what_ships(digest: str) -> None:
    runs = json.loads((ROOT / "benchmarks/perpetual.json").read_text("utf-8"))["runs"]
    for name, own in (("tracker", digest), ("keypoints", None)):
        own = own or digest_of(open_run(name).tracker.policy)
        card = (ROOT / f"docs/model_cards/{name}.md").read_text("utf-8")
        assert f"policy `{own}`" in card
        assert runs[name]["about"]["policy"] == own == runs[f"{name} on Bandai"]["about"]["policy"]


def test_compliance_names_the_policy_of_each_figure(digest: str) -> None:
    """The page names an earlier policy by its millions of control steps."""
    told = json.loads((ROOT / "benchmarks/compliance.json").read_text("utf-8"))
    policies, page = told.pop("policies"), (ROOT / "docs/compliance.md").read_text("utf-8")
    parts: set[str] = set()
    told.pop("cost")  # of an environment, without a policy
    for part, rows in told.items():
        one_by_one = part == "scenes" or part.startswith("throws")
        parts |= {f"{part}/{name}" for name in rows if name != "episodes"} if one_by_one else {part}
    assert parts == policies.keys()
    before = {str(p["million_steps"]) for p in policies.values() if p["digest"] != digest}
    assert {m for m in before if m in page} == before
    assert f"{open_run(None).tracker.about['samples'] / 1e6:.1f} million" in page
