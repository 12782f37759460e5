"""The site of docs/: its menu names pages that exist, and so do the names of the API pages."""

from __future__ import annotations

import importlib.util
import re
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
#: `::: poise.module` and the members that are shown of it, none for all.
_SHOWN = re.compile(r"^::: ([\w.]+)\n    options: \{[^}\n]*?(?:members: \[([^\]]*)\])?\}$", re.MULTILINE)


@pytest.fixture(scope="module")
def hooks() -> ModuleType:
    spec = importlib.util.spec_from_file_location("site_hooks", DOCS / "site_hooks.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_menu_names_pages_that_exist() -> None:
    text = (ROOT / "mkdocs.yml").read_text("utf-8")
    menu = re.findall(r"^ +- (?:[\w ]+: )?([\w/.-]+\.md)$", text, re.MULTILINE)
    pages = {p.relative_to(DOCS).as_posix() for p in DOCS.rglob("*.md")}
    pages |= {f"notebooks/{p.stem}.md" for p in (DOCS / "notebooks").glob("*.ipynb")}
    assert len(menu) == len(set(menu)) > 40 and set(menu) <= pages
    begin = {"index.md", "install.md", "python.md", "animator.md", "researcher.md", "avatar.md"}
    assert begin <= set(menu)


@pytest.mark.parametrize("page", sorted((DOCS / "api").glob("*.md")), ids=lambda p: p.name)
def test_what_the_api_pages_show_exists_and_says_what_it_is(page: Path) -> None:
    text = page.read_text("utf-8")
    shown = _SHOWN.findall(text)
    assert len(shown) == text.count("\n::: ") > 0
    for name, members in shown:
        module = import_module(name)
        for member in filter(None, members.split(", ")):
            found = getattr(module, member)
            assert found.__module__ == name, f"{member} is in {found.__module__}"
            assert found.__doc__, member


def test_the_face_is_documented() -> None:
    import poise

    text = (DOCS / "api" / "face.md").read_text("utf-8")
    for name in ("imitate", "track", "push", "inbetween", "complete", "dream", "open_run", "Run"):
        assert name in poise.__all__ and re.search(rf"\b{name}\b", text), name


def test_links_out_of_docs_become_names(hooks: ModuleType) -> None:
    class Page:
        class file:  # noqa: N801
            src_uri = "track.md"

    said = hooks.on_page_markdown("[a](../src/x.py#top) [b](gpu.md) ![c](../c.png)", Page, None, None)
    assert said == "a (`src/x.py`) [b](gpu.md) ![c](../c.png)"
    Page.file.src_uri = "api/face.md"
    assert hooks.on_page_markdown("[a](../python.md)", Page, None, None) == "[a](../python.md)"


def test_notebooks_become_pages(hooks: ModuleType) -> None:
    page = hooks.page_of(DOCS / "notebooks" / "01_imitate.ipynb")
    assert page.startswith("# Imitate a clip\n\n[The notebook](01_imitate.ipynb)")
    assert page.count("```python") == 4 and "import poise" in page
