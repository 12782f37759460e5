"""The site of docs/: its menu names the pages that exist, and the face of Poise is on one of them."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"


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
    assert len(menu) == len(set(menu)) and set(menu) == pages


def test_the_face_is_documented() -> None:
    import poise

    text = (DOCS / "python.md").read_text("utf-8")
    for name in poise.__all__:
        assert name.startswith("__") or f"### poise.{name}\n" in text or f".{name}\n" in text, name


def test_links_out_of_docs_become_names(hooks: ModuleType) -> None:
    class Page:
        class file:  # noqa: N801
            src_uri = "track.md"

    said = hooks.on_page_markdown("[a](../src/x.py#top) [b](gpu.md) ![c](../c.png)", Page, None, None)
    assert said == "a (`src/x.py`) [b](gpu.md) ![c](../c.png)"
    Page.file.src_uri = "notebooks/01.md"
    assert hooks.on_page_markdown("[a](../python.md)", Page, None, None) == "[a](../python.md)"


def test_notebooks_become_pages(hooks: ModuleType) -> None:
    page = hooks.page_of(DOCS / "notebooks" / "01_imitate.ipynb")
    assert page.startswith("# Imitate a clip\n\n[The notebook](01_imitate.ipynb)")
    assert page.count("```python") == 4 and "import poise" in page
