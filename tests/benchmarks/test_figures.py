"""Rows of `results/`: a policy that ships is that of its file, and every row says how it was made."""

from __future__ import annotations

import csv
import hashlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / "src" / "poise" / "data"
COLUMNS = ["subject", "metric", "value", "spread", "n", "seeds", "policy", "commit", "command"]
MORE = ["core_hours", "machine"]
SUITES = sorted(f for f in (ROOT / "results").glob("*.csv") if f.stem != "policies")
POLICY = re.compile(r"([\w-]+-v\d+) ([0-9a-f]{16})")


def _rows(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as text:
        return list(csv.DictReader(text))


@pytest.fixture(scope="module")
def policies() -> dict[str, dict[str, str]]:
    return {row["policy"]: row for row in _rows(ROOT / "results" / "policies.csv")}


def test_the_last_policy_of_each_file_is_the_one_that_ships(policies: dict[str, dict[str, str]]) -> None:
    """`policies.csv` gets a row when another policy comes along, and rows of the one before say so."""
    latest = {row["file"]: row for row in policies.values()}
    assert {*latest} == {f.relative_to(DATA).as_posix() for f in DATA.rglob("*.safetensors")}
    for name, row in latest.items():
        digest = hashlib.sha256((DATA / name).read_bytes()).hexdigest()[:16]
        assert row["digest"] == digest, f"{name}: add the policy that ships now to results/policies.csv"


@pytest.mark.parametrize("file", SUITES, ids=lambda file: file.stem)
def test_rows_name_their_policy_and_how_they_were_made(
    file: Path, policies: dict[str, dict[str, str]]
) -> None:
    rows = _rows(file)
    assert rows and list(rows[0]) in (COLUMNS, COLUMNS + MORE)
    for row in rows:
        told = f"{file.name}: {row['subject']}, {row['metric']}"
        assert row["subject"] and row["metric"] and row["command"], told
        assert row["commit"] or row["policy"] == "published", told
        float(row["value"])
        for name, digest in POLICY.findall(row["policy"]):
            assert policies[name]["digest"] == digest, f"{told}: {name} has another digest"
