"""Parsers in a process of their own: whatever becomes of it is an answer or one sentence."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from poise.body import mjcf
from poise.errors import PoiseError
from poise.formats import c3d, fbx, limited, usd
from poise.formats.limited import read_limited


def job(folder: Path, body: str) -> Path:
    script = folder / "job.py"
    lines = "".join(f"    {line}\n" for line in body.splitlines())
    script.write_text(
        f"import os, signal, time\nimport numpy as np\ndef read(path, refuse, **o):\n{lines}"
    )
    return script


def refusal(folder: Path, body: str) -> str:
    file = folder / "a.bin"
    file.write_bytes(b"0" * 10)
    with pytest.raises(PoiseError) as error:
        read_limited(job(folder, body), file, 10, "BIN file")
    said = str(error.value)
    assert said.startswith(f"{file}: ") and "\n" not in said and len(said) < len(str(file)) + 200
    return said.removeprefix(f"{file}: ")


def test_an_answer_comes_back_whatever_else_is_printed(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(b"abc")
    body = (
        "print('noise', flush=True)\nreturn {'a': np.arange(o['n']), 'b': np.array(open(path).read())}"
    )
    held = read_limited(job(tmp_path, body), tmp_path / "a.bin", 3, "BIN file", n=3)
    assert held["a"].tolist() == [0, 1, 2] and str(held["b"]) == "abc"


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("refuse('it is bad', 'Make it good')", "it is bad. Make it good"),
        ("raise ValueError('line\\n\\x1b[31m two')", "the BIN file is damaged ('line ?[31m two')"),
        ("raise SystemExit(7)", "the BIN file is damaged ('7'). The file seems cut off"),
        ("os._exit(7)", "the BIN file is damaged (reading ended with 7). The file seems cut off"),
        ("os._exit(0)", "the BIN file is damaged (reading ended with 0). The file seems cut off"),
        ("os.write(1, b'x'); os._exit(3)", "the BIN file is damaged (reading ended with 3)"),
        ("raise MemoryError", "the BIN file takes more than 1.1 GB to read"),
    ],
)
def test_every_end_is_a_sentence(tmp_path: Path, body: str, said: str) -> None:
    assert refusal(tmp_path, body).startswith(said)


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals")
def test_a_crash_is_a_sentence(tmp_path: Path) -> None:
    assert "(what reads it crashed)" in refusal(tmp_path, "os.kill(os.getpid(), signal.SIGKILL)")


@pytest.mark.parametrize("body", ["time.sleep(600)", "while True: pass"])
def test_no_end_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str) -> None:
    monkeypatch.setattr(limited, "SECONDS", 1.0)
    monkeypatch.setattr(limited, "_PATIENCE", 4.0)
    assert refusal(tmp_path, body) == "the BIN file could not be read in 1 s. It seems damaged"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory has no limit there")
def test_memory_has_a_limit_that_grows_with_the_file(tmp_path: Path) -> None:
    body = "return {'a': np.ones(1 << 30)}"
    assert refusal(tmp_path, body).startswith("the BIN file takes more than 1.1 GB to read")


def test_where_nothing_can_be_limited_files_are_read_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from poise.formats import apart

    monkeypatch.setitem(sys.modules, "resource", None)
    apart.limit(1.0, 1 << 20)
    monkeypatch.setattr(limited.sys, "executable", str(tmp_path / "none"))
    assert refusal(tmp_path, "return {}").startswith("no process could be started to read it")


def test_modules_beside_the_users_files_are_not_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "evil.py").write_text("")
    (tmp_path / "a.bin").write_bytes(b"0")
    monkeypatch.chdir(tmp_path)
    body = "try:\n    import evil\nexcept ImportError:\n    return {'a': np.zeros(1)}"
    assert "a" in read_limited(job(tmp_path, body), tmp_path / "a.bin", 1, "BIN file")


def test_every_script_that_reads_apart_is_there() -> None:
    # Tests of these formats are skipped where their packages are missing, and so would miss it.
    scripts = {
        path.with_name(name)
        for module in (c3d, fbx, usd, limited, mjcf)
        for path in [Path(module.__file__)]
        for name in re.findall(r'with_name\("(\w+\.py)"\)', path.read_text(encoding="utf-8"))
    }
    assert len(scripts) == 5 and all(script.is_file() for script in scripts)
