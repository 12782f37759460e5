"""Checks what is written by hand in the documents: how long it is, and that it states no figure.

A measured figure belongs into a table that `docs/generate.py` makes from `results/`. A number that is a
setting, an option or a name stands in backticks or in a block of code; small counts are words.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from generate import DOCS, by_hand, generated

#: Pages of the site; words of a page and of all pages, without what is generated; words and lines of the
#: README; words of the change log.
PAGES, PAGE_WORDS, ALL_WORDS, README_WORDS, README_LINES, LOG_WORDS = 16, 1200, 20_000, 600, 90, 2500

_CODE = (
    re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL),
    re.compile(r"^    .*$", re.MULTILINE),
    re.compile(r"`[^`]*`"),
    re.compile(r"\]\([^)]*\)"),
    re.compile(r"<!--.*?-->", re.DOTALL),
    # Names that hold a number.
    re.compile(r"Apache License 2\.0|CC0 1\.0|Sec(?:\.|tion) \d+(?:\.\d+)*"),
)
_UNITS = (
    r"%|percent|mm|cm|dm|m|km|ms|s|min|minutes?|hours?|days?|weeks?|seconds?|k?Hz|N|J|W|kg|g|rad|degrees?|°|kB|MB|GB|[KMG]iB|"
    r"times|fold|x|million|thousand|samples?|steps?|points?"
)
_NUMBER = r"(?<![\w.,])[-+±]?\d[\d,]*(?:\.\d+)?"
FIGURE = re.compile(
    rf"{_NUMBER}\s?(?:{_UNITS})(?![\w-])|{_NUMBER} of {_NUMBER}|(?<![\w.])\d*\.\d+(?!\w|\.\w)"
)


def words(page: str) -> int:
    """Words that were written by hand: anything with a letter or a digit."""
    return len(re.findall(r"\S*\w\S*", by_hand(page)))


def figures(page: str) -> list[str]:
    """Numbers with a unit, shares and decimals in the prose of a page, with the words around them."""
    prose = by_hand(page)
    for pattern in _CODE:
        prose = pattern.sub(" ", prose)
    found = []
    for match in FIGURE.finditer(prose):
        around = prose[max(0, match.start() - 30) : match.end() + 20]
        found.append(f"{match[0]!r} in '{' '.join(around.split())}'")
    return found


def problems() -> list[str]:
    """One sentence for each page that is too long or states a figure."""
    root, out = DOCS.parent, list[str]()
    pages = sorted(DOCS.rglob("*.md"))
    texts = {page.name: page.read_text("utf-8") for page in pages}
    counts = {name: words(text) for name, text in texts.items()}
    if len(pages) > PAGES:
        out.append(f"docs: {len(pages)} pages, at most {PAGES}")
    if sum(counts.values()) > ALL_WORDS:
        out.append(f"docs: {sum(counts.values())} words, at most {ALL_WORDS}")
    # READMEs of the papers, as long as pages; neither pages of the site nor of its words.
    beside = {
        p.relative_to(root).as_posix(): p.read_text("utf-8") for p in generated() if "src" in p.parts
    }
    texts |= beside
    counts |= {name: words(text) for name, text in beside.items()}
    out += [f"{name}: {n} words, at most {PAGE_WORDS}" for name, n in counts.items() if n > PAGE_WORDS]
    readme, log = ((root / name).read_text("utf-8") for name in ("README.md", "CHANGELOG.md"))
    texts |= {"README.md": readme, "CHANGELOG.md": log}
    lines = readme.count("\n")
    if words(readme) > README_WORDS or lines > README_LINES:
        out.append(
            f"README.md: {words(readme)} words and {lines} lines, at most {README_WORDS}, {README_LINES}"
        )
    if words(log) > LOG_WORDS:
        out.append(f"CHANGELOG.md: {words(log)} words, at most {LOG_WORDS}")
    out += [f"{name}: a figure, {found}" for name, text in texts.items() for found in figures(text)]
    return out


def main() -> int:
    """Reports what is too long and what states a figure; the exit status is 1 if anything does."""
    found = problems()
    sys.stdout.writelines(f"{sentence}\n" for sentence in found)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
