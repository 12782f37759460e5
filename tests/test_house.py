"""House rules that no linter knows: quiet libraries, safe loading, clean text."""

from __future__ import annotations

import ast
import functools
import re
import subprocess
from pathlib import Path

import pytest

from marks import MARKS

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "poise"

_MACHINE = tuple(
    rf"(?<![\w.$}}>)~])/{path}" for path in ("work/", "root/", "home/[a-z]", "tmp/", "opt/")
)
_HOSTS = ("pypi\\.org", "pythonhosted", "npmjs", "download\\.pytorch", "anaconda\\.org", "index-url")
_UNFINISHED = (r"\bTODO\b", r"\bFIXME\b", r"\bXXX\b", "NotImplementedError")


def _python() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def _texts() -> list[Path]:
    """Text files that are tracked or about to be; minified scripts, the licence and this list apart."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", "-z"],
        cwd=ROOT,
        capture_output=True,
        check=False,
    )
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    files = [ROOT / name for name in listed.stdout.decode().split("\0") if name]
    apart = (ROOT / "LICENSE", Path(__file__).resolve())
    kept = [f for f in files if f.is_file() and ".min." not in f.name and f not in apart]
    return [f for f in kept if b"\0" not in f.read_bytes()[:8192]]


def _hits(files: list[Path], patterns: tuple[str, ...]) -> list[str]:
    found = re.compile("|".join(patterns))
    return [
        f"{file.relative_to(ROOT)}:{number}: {line.strip()[:100]}"
        for file in files
        for number, line in enumerate(file.read_text(encoding="utf-8", errors="replace").splitlines(), 1)
        if found.search(line)
    ]


@functools.cache
def _nodes(file: Path) -> list[ast.AST]:
    return list(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))


def _dotted(node: ast.expr) -> str:
    """`a.b.c`, or "" for what is no name."""
    if isinstance(node, ast.Attribute):
        return f"{_dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def _calls(file: Path) -> list[tuple[int, str]]:
    """Line and dotted name of every call in a file."""
    return [(n.lineno, _dotted(n.func)) for n in _nodes(file) if isinstance(n, ast.Call)]


def test_only_the_command_line_prints() -> None:
    loud = [
        f"{f.relative_to(ROOT)}:{line}"
        for f in _python()
        if "cli" not in f.relative_to(PACKAGE).parts
        for line, name in _calls(f)
        if name in ("print", "input", "breakpoint")
    ]
    assert loud == []


def test_nothing_that_is_loaded_can_run_code() -> None:
    unsafe_modules = {"pickle", "cPickle", "dill", "joblib", "shelve", "marshal", "cloudpickle"}
    unsafe_calls = {"torch.load", "torch.save", "eval", "exec", "os.system"}
    # One file reads pickles of motion by an allow-list of instructions, and never lets pickle load them.
    reader = PACKAGE / "formats/pickles.py"
    unsafe_calls |= {"pickle.load", "pickle.loads", "pickle.Unpickler", "pickle._Unpickler"}
    found = []
    for file in _python():
        for node in _nodes(file):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            found += [
                f"{file.name}:{node.lineno} {n}"
                for n in names
                if n.split(".")[0] in unsafe_modules and not (file == reader and n == "pickle")
            ]
        found += [f"{file.name}:{line} {name}" for line, name in _calls(file) if name in unsafe_calls]
        text = file.read_text(encoding="utf-8")
        found += [file.name] if re.search(r"allow_pickle\s*=\s*True", text) else []
    assert found == []


def test_text_names_no_machine_and_no_registry() -> None:
    assert _hits(_texts(), _MACHINE + _HOSTS) == []


def test_nothing_is_left_unfinished() -> None:
    code = [f for f in _texts() if f.suffix in (".py", ".pyi", ".js", ".toml", ".md", ".css", ".html")]
    assert _hits(code, _UNFINISHED) == []


def test_every_module_says_what_it_is() -> None:
    silent = [
        f.relative_to(ROOT)
        for f in _python()
        if not ast.get_docstring(_nodes(f)[0])  # type: ignore[arg-type]
    ]
    assert silent == []


def test_marks_are_of_tests_that_exist() -> None:
    tests = ROOT / "tests"
    for begins in (name for names in MARKS.values() for name in names):
        file, _, test = begins.partition("[")[0].partition("::")
        found = [f for f in tests.rglob("*.py") if f.relative_to(tests).as_posix().startswith(file)]
        assert found and (not test or f"\ndef {test}" in found[0].read_text("utf-8")), begins
