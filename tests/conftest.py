"""Marks of the tests that `make test` leaves out, and the real clips, where they are present."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
import torch

from marks import MARKS

torch.set_num_threads(1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    for item in items:
        if item.path.is_relative_to(here):
            inside = item.nodeid[len(item.nodeid.split("::")[0]) :]
            name = item.path.relative_to(here).as_posix() + inside
            for mark, beginnings in MARKS.items():
                if name.startswith(beginnings):
                    item.add_marker(mark)


def _find_data() -> Path | None:
    """The unpacked clips: $POISE_DATA, the cache, or `../shared/data/unpack` beside the checkout."""
    for folder in (os.environ.get("POISE_DATA"), Path.home() / ".cache/poise/data"):
        if folder and (Path(folder) / "INDEX.tsv").exists():
            return Path(folder)
    unpack = Path(__file__).resolve().parents[2] / "shared/data/unpack"
    if unpack.exists():
        done = subprocess.run(["bash", str(unpack)], capture_output=True, text=True, check=False)
        if done.returncode == 0 and done.stdout.strip():
            return Path(done.stdout.strip().splitlines()[-1])
    return None


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real clips; the test is skipped when it is absent."""
    found = _find_data()
    if found is None:
        pytest.skip("the real clips are not on this machine")
    return found
