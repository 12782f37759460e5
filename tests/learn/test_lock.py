"""Two trainings in one folder: the second is refused, whatever became of the first."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_inbetween_training import trainer

from poise.errors import PoiseError
from poise.learn import checkpoint as lock
from poise.learn.checkpoint import only_writer
from poise.learn.inbetween_model import train_inbetween
from refusals import refused

pytestmark = pytest.mark.skipif(os.name != "posix", reason="folders cannot be locked there")
HOLD = """
import sys, time, pathlib
from poise.learn.checkpoint import only_writer
with only_writer(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


def test_the_second_writer_is_refused_and_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "PATIENCE_S", 0.0)
    folder = tmp_path / "run"
    with only_writer(folder):
        with pytest.raises(PoiseError) as error, only_writer(folder):
            pass
        assert str(error.value) == (
            f"{folder}: another training writes here. Wait until it ends, or choose another folder"
        )
        with refused("folder-in-use"):
            train_inbetween(trainer("transformer"), folder)
        assert list(folder.iterdir()) == []
    with only_writer(folder):
        pass


def test_a_training_that_was_killed_holds_nothing(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None and process.stdout.readline().strip() == b"held"
        process.kill()
        process.wait()
        with only_writer(tmp_path):
            pass
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def test_a_folder_that_cannot_be_locked_is_written_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import fcntl

    def refuses(*_: object) -> None:
        raise OSError(95, "not supported")

    monkeypatch.setattr(fcntl, "flock", refuses)
    with only_writer(tmp_path / "run"), only_writer(tmp_path / "run"):
        pass
