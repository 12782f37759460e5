"""Marks of the tests that `make test` leaves out, and the real clips, where they are present."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
import torch

torch.set_num_threads(1)

#: Beginnings of the names of tests, by the mark that they get; pyproject.toml says what the marks mean.
MARKS = {
    "process": (
        "cli/test_cli_fleet.py::test_a_f", "cli/test_cli_fleet.py::test_ctrl_c",
        "cli/test_cli_imitate.py::test_ctrl_c", "cli/test_cli_torchrun.py::test_two_processes",
        "cli/test_cli_verbs.py::test_a_closed_pipe", "cli/test_cli_verbs.py::test_info_loads",
        "cli/test_cli_verbs.py::test_version_and_help", "formats/test_fuzz_runner.py::test_a_run",
        "jobs/test_disk.py::test_a_full_disk", "jobs/test_fleet.py", "jobs/test_fleet_ray.py",
        "jobs/test_resume_imitation.py", "jobs/test_track_policy.py::test_a_program",
        "integrations/test_blender.py", "learn/test_lock.py::test_a_training_that_was_killed",
        "learn/test_parallel.py", "learn/test_train.py::test_kills", "live/test_record.py::test_kill_9",
        "test_face.py::test_importing",
    ),
    "browser": (
        "live/test_page.py::test_push_fall", "report/test_report_browser.py",
    ),
    "learned": ("jobs/test_shipped_tracker.py", "jobs/test_track_supports.py::test_a_motion_that_sits"),
    "training": (
        "jobs/test_demonstrations.py", "jobs/test_perpetual_resume.py",
        "learn/test_ppo.py::test_ppo_solves",
    ),
    "docs": (
        "test_docs.py::test_python_snippets_run", "test_docs_commands.py", "test_notebooks.py",
    ),
    "benchmarks": ("benchmarks/",),
}  # fmt: skip


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
