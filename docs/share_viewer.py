"""Lets the reports in docs/replays share one viewer, `viewer.js` beside them, in place of one each.

    poise play compliant door -o opened
    cp opened/report.html docs/replays/door.html
    python docs/share_viewer.py

The pages still open from disk. One that holds another viewer than the rest is refused: then all of them
are to be made anew.
"""

from __future__ import annotations

import re
from pathlib import Path

REPLAYS = Path(__file__).resolve().parent / "replays"
VIEWER = "viewer.js"
_SCRIPT = re.compile(r"<script>(.*?)</script>\n?", re.DOTALL)
_OWN = "script-src 'unsafe-inline';"
_SHARED = "script-src 'self' file:;"
_ALONE = (
    "This page is one file and loads nothing from the network. The replay uses three.js (MIT licence, "
    "text in the page's source)."
)
_BESIDE = (
    f"This page loads {VIEWER} from beside it and nothing else. The replay uses three.js (MIT licence, "
    f"text in {VIEWER})."
)


def shared(page: str) -> tuple[str, str]:
    """The page with a link to its viewer, and the viewer that it held; empty where it held none."""
    scripts = _SCRIPT.findall(page)
    if not scripts:
        return page, ""
    head, *between, tail = _SCRIPT.split(page)[::2]
    link = f'<script src="{VIEWER}"></script>\n'
    # The motion stands before the scripts, and each script in a block of its own keeps its names.
    page = head + link + "".join(between) + tail
    viewer = "\n;\n".join(s.strip() for s in scripts) + "\n"
    return page.replace(_OWN, _SHARED).replace(_ALONE, _BESIDE), viewer


def main(folder: Path = REPLAYS) -> None:
    """Rewrites the pages that hold a viewer of their own."""
    viewer = folder / VIEWER
    pages = {path: shared(path.read_text("utf-8")) for path in sorted(folder.glob("*.html"))}
    held = {text for _, text in pages.values() if text}
    linked = any(not text for _, text in pages.values())
    if linked and viewer.exists():
        held.add(viewer.read_text("utf-8"))
    if len(held) != 1:
        raise SystemExit("the pages hold different viewers: make all of them anew")
    viewer.write_text(held.pop(), "utf-8", newline="\n")
    for path, (page, text) in pages.items():
        if text:
            path.write_text(page, "utf-8", newline="\n")


if __name__ == "__main__":
    main()
