"""The replays of the docs share one viewer: the same script, beside pages that hold motion alone."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
from fake_report import make_report

from poise.score.report.page import render

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("share_viewer", DOCS / "share_viewer.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_pages_share_what_they_all_held(tool: ModuleType, tmp_path: Path) -> None:
    page = render(make_report())
    for name in ("one", "two"):
        (tmp_path / f"{name}.html").write_text(page, "utf-8")
    tool.main(tmp_path)
    viewer, short = (
        (tmp_path / "viewer.js").read_text("utf-8"),
        (tmp_path / "one.html").read_text("utf-8"),
    )
    assert len(viewer) > 400_000 and "</script" not in viewer and "MIT License" in viewer
    assert len(page) - len(short) > 400_000
    assert short.count("<script") == 2 and short.count('<script src="viewer.js"></script>') == 1
    assert short.index('id="motion"') < short.index('viewer.js"')
    assert "script-src 'self' file:;" in short and "This page loads viewer.js" in short
    # What is shared already stays; a page that is added comes to it.
    (tmp_path / "three.html").write_text(page, "utf-8")
    tool.main(tmp_path)
    assert (tmp_path / "three.html").read_text("utf-8") == short
    (tmp_path / "four.html").write_text(
        page.replace("</script>\n</body>", "1;</script>\n</body>"), "utf-8"
    )
    with pytest.raises(SystemExit, match="different viewers"):
        tool.main(tmp_path)


def test_the_pages_of_the_docs_are_so() -> None:
    pages = sorted((DOCS / "replays").glob("*.html"))
    assert len(pages) >= 7 and (DOCS / "replays" / "viewer.js").stat().st_size > 400_000
    for path in pages:
        text = path.read_text("utf-8")
        assert text.count("<script") == 2 and '<script src="viewer.js"></script>' in text, path.name
