"""The runner that anyone can start: it damages, counts by format, and adds to what is there."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fuzz.oracle import Verdict
from fuzz.tally import Tally, key_of, record

ROOT = Path(__file__).resolve().parents[2]


def test_counts_by_format_and_sums_over_runs(tmp_path: Path) -> None:
    tally = Tally()
    refused = Verdict("refused", ", line 7: 'abc' is not a number")
    assert tally.add("bvh", refused, True) == (key_of("bvh", refused), False)
    tally.add("bvh", Verdict("read"), True)
    tally.add("bvh", Verdict("read"), False)
    wrong = Verdict("traceback", "file.py:12 IndexError: 3")
    assert tally.add("npz", wrong, False)[1] and not tally.add("npz", wrong, False)[1]
    assert key_of("npz", wrong) == key_of("npz", Verdict("traceback", "file.py:99 IndexError: 4"))
    path = tmp_path / "counts.json"
    for options in (["--seed", "1"], ["--seed", "2"]):
        save = record(path, options)
        # Now and then, of one run: it counts once.
        save(tally)
        save(tally)
    told = json.loads(path.read_text())
    assert told["commands"] == ["python -m tests.fuzz --seed 1", "python -m tests.fuzz --seed 2"]
    assert told["files"] == 10 and told["odd"] == {key_of("npz", wrong): wrong.text}
    assert told["formats"]["bvh"] == {
        "inputs": 6, "refused": 2, "read": 4, "round_trips": 2, "wrong": 0
    }  # fmt: skip
    assert told["formats"]["npz"]["wrong"] == 4


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the runner forks")
def test_a_run_finds_nothing_in_a_few_files(tmp_path: Path) -> None:
    """Of a native library, in a fork of the process that reads."""
    command = f"{sys.executable} -m tests.fuzz --files 16 --formats mjcf --seed 5".split()
    done = subprocess.run(
        [*command, "--json", str(tmp_path / "counts.json"), "--keep", str(tmp_path / "kept")],
        cwd=ROOT, capture_output=True, text=True, timeout=220, check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT / "src")},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    told = json.loads((tmp_path / "counts.json").read_text())
    assert told["files"] == 16 and told["odd"] == {}
    assert told["formats"]["mjcf"]["refused"] > 0
    assert (tmp_path / "kept/kept_5.tar.xz").exists()
