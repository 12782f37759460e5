"""What the site needs beside its theme: pages of notebooks, and no links to files beside docs/."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

NOTEBOOKS = Path(__file__).resolve().parent / "notebooks"
_OUT = re.compile(r"(?<!!)\[([^\]]+)\]\(((?:\.\./)+[^)\s]+)\)")


def on_files(files: Any, config: Any) -> Any:
    """Adds a page for every notebook."""
    from mkdocs.structure.files import File

    for notebook in sorted(NOTEBOOKS.glob("*.ipynb")):
        name = f"notebooks/{notebook.stem}.md"
        files.append(File.generated(config, name, content=page_of(notebook)))
    return files


def page_of(notebook: Path) -> str:
    """A notebook as markdown, with a link to the file at its top."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    parts = []
    for cell in cells:
        text = "".join(cell["source"])
        parts.append(f"```python\n{text}\n```" if cell["cell_type"] == "code" else text)
    title, *rest = parts[0].split("\n", 1)
    head = f"{title}\n\n[The notebook]({notebook.name})"
    return "\n\n".join([head, *rest, *parts[1:]]) + "\n"


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Links to files beside docs/ have no page here: the file is named instead."""
    depth = page.file.src_uri.count("/")

    def named(found: re.Match[str]) -> str:
        text, target = found.groups()
        ups = target.count("../")
        if ups <= depth:
            return found.group(0)
        name = target.replace("../", "").partition("#")[0]
        return text if name in text else f"{text} (`{name}`)"

    return _OUT.sub(named, markdown)
