"""The structure of the source: no import cycle, also not inside functions; what users import is checked
strictly."""

from __future__ import annotations

import ast
import re
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import grimp

from poise import __file__ as package

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src"
#: Modules that are public wherever they are imported.
ALWAYS = ("__init__.py", "errors.py", "settings.py", "version.py")


def test_no_module_imports_itself_over_others() -> None:
    graph = grimp.build_graph("poise", exclude_type_checking_imports=True, cache_dir=None)
    imported = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    assert len(imported) > 100
    TopologicalSorter(imported).prepare()  # raises CycleError


def test_a_file_shares_its_name_with_no_other() -> None:
    """But a verb's command line with its job: `cli/push.py` and `jobs/push.py`."""
    source, places = Path(package).parent, defaultdict(set)
    for path in source.rglob("*.py"):
        if path.name != "__init__.py":
            places[path.name].add(path.parent.relative_to(source).as_posix())
    verbs = {name for name, folders in places.items() if folders == {"cli", "jobs"}}
    assert [name for name, folders in places.items() if len(folders) > 1 and name not in verbs] == []
    assert "push.py" in verbs


def test_public_modules_are_checked_strictly() -> None:
    """What users import, by the documents and by `import poise`, is in the list of strict modules."""
    imports = re.compile(r"^ *(from poise[.\w]* import (?:\([^)]*\)|.*))$", re.MULTILINE)
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    lines = [line for page in pages for line in imports.findall(page.read_text("utf-8"))]
    face = (SOURCE / "poise" / "__init__.py").read_text("utf-8")
    names = [name for text in (face, *lines) for name in _imported(text)]
    public = {_defining(module, name) for module, name, _ in names}
    public |= {SOURCE / "poise" / name for name in ALWAYS}
    checked = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["pyright"]["strict"]
    assert all((ROOT / file).is_file() for file in checked)
    assert sorted({file.relative_to(ROOT).as_posix() for file in public} - {*checked}) == []


def _imported(text: str) -> Iterator[tuple[str, str, str]]:
    """(module, its name there, its name here) of each name that a text imports from Poise."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "poise":
            yield from ((node.module or "", a.name, a.asname or a.name) for a in node.names)


def _defining(module: str, name: str) -> Path:
    """The file that defines a name which a module may only hand on; that of a module is itself."""
    place = SOURCE.joinpath(*module.split("."))
    file = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
    for source, there, here in _imported(file.read_text("utf-8")):
        if here == name:
            return _defining(source, there)
    inner = [place / name / "__init__.py", place / f"{name}.py"]
    return next((f for f in inner if f.is_file()), file)
