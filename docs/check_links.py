"""Checks that every relative link in the markdown files leads to a file and, if named, a heading."""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
_FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
_HEADING = re.compile(r"^#+ +(.+?) *$", re.MULTILINE)


def pages() -> list[Path]:
    """The markdown files of the repository, but for tables that scripts of the benchmarks write."""
    folders = ("docs", "benchmarks/notes", "training", "integrations", "src")
    return sorted(
        [
            *ROOT.glob("*.md"),
            ROOT / "benchmarks/README.md",
            *(page for name in folders for page in (ROOT / name).rglob("*.md")),
        ]
    )


def anchors(text: str) -> set[str]:
    """The names under which the headings of a page can be linked to."""
    names = set()
    for heading in _HEADING.findall(_FENCE.sub("", text)):
        plain = re.sub(r"[^\w\- ]", "", heading.lower())
        names.add(plain.replace(" ", "-"))
    return names


def broken(page: Path) -> list[str]:
    """One sentence per link of `page` that leads nowhere; links to other sites are not followed."""
    text, found = page.read_text(encoding="utf-8"), []
    for target in _LINK.findall(_FENCE.sub("", text)):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        file = page.parent / name if name else page
        if not file.exists():
            found.append(f"{page.relative_to(ROOT)}: {target} does not exist")
        elif anchor and anchor not in anchors(file.read_text(encoding="utf-8")):
            found.append(f"{page.relative_to(ROOT)}: {target} names no heading")
    return found


def main() -> int:
    """Reports broken links; the exit status is 1 if there are any."""
    problems = [sentence for page in pages() for sentence in broken(page)]
    sys.stdout.writelines(f"{sentence}\n" for sentence in problems)
    if not problems:
        sys.stdout.write(f"{len(pages())} pages, all links lead somewhere\n")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
