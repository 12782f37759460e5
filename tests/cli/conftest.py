"""One tiny training that all tests of the command line share, and the check of a refusal."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tiny_clips import MINIATURE, deepmimic, put

from made_once import copied
from poise.cli.main import main


@pytest.fixture(scope="session")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return put(tmp_path_factory.mktemp("clip"), "stand.txt", deepmimic())


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory, clip: Path) -> Path:
    """The result folder of a miniature training; tests that change it take a copy."""

    def make(place: Path) -> None:
        argv = ["imitate", str(clip), "-o", str(place / "stand"), *MINIATURE]
        argv.remove("--no-expert")
        assert main(argv) == 0

    return copied("imitated", make, tmp_path_factory.mktemp("results")) / "stand"


def listing(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))


@pytest.fixture
def answered(capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    """Runs a command line with --json; gives the document, which alone stands on stdout."""

    def check(*argv: object, code: int = 0) -> dict[str, Any]:
        capsys.readouterr()
        assert main([*map(str, argv), "--json"]) == code
        document = json.loads(capsys.readouterr().out)
        assert document["exit_code"] == code and document["verb"] == argv[0]
        return document

    return check


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Callable[..., str]:
    """Runs a command line that must fail: exit code 2, one error line, nothing written in `tmp_path`."""

    def check(*argv: object, words: tuple[str, ...] = ()) -> str:
        before = listing(tmp_path)
        capsys.readouterr()
        code = main([str(a) for a in argv])
        said, complained = capsys.readouterr()
        assert code == 2, complained
        lines = complained.splitlines()
        # What it reads is said before it is read.
        assert [x.startswith("error: ") for x in lines[-2:]] in ([True], [False, True]), complained
        assert "Traceback" not in complained + said
        for word in words:
            assert word in complained
        assert listing(tmp_path) == before
        return complained

    return check
