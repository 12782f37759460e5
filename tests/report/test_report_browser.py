"""The page in a real browser: it starts without errors and its controls work (needs Chromium)."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from fake_report import make_report

from poise.score.report.data import Shape
from poise.score.report.page import render

_CHROMIUM = next(
    (
        found
        for name in ("chromium", "chromium-browser", "google-chrome", "chrome")
        if (found := shutil.which(name))
    ),
    None,
)
_FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--use-gl=angle",
    "--use-angle=swiftshader", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--virtual-time-budget=4000", "--dump-dom",
)  # fmt: skip

_BOX = (Shape(0, "box", (0.2, 0.2, 0.2), (1.0, 0.0, 0.2)),)

# Pauses, seeks by a click in the middle of the strip, steps two frames on, overlays, and notes it.
_PROBE = """<script>
addEventListener("load", () => setTimeout(() => {
  const key = (key) => document.body.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
  const seen = [];
  const note = (id, name) => seen.push(name ? document.getElementById(id).getAttribute(name)
    : document.getElementById(id).textContent.trim());
  const strip = document.getElementById("strip");
  strip.setPointerCapture = () => {};
  key(" ");
  note("play", "aria-label");
  const box = strip.getBoundingClientRect();
  strip.dispatchEvent(new PointerEvent("pointerdown", { clientX: box.left + box.width / 2 }));
  note("now-frame");
  key("ArrowRight");
  key("ArrowRight");
  note("now-frame");
  key("o");
  note("over", "aria-pressed");
  key("l");
  note("now-frame");
  document.documentElement.dataset.seen = seen.join("|");
}, 300));
</script></body>"""


@pytest.mark.skipif(_CHROMIUM is None, reason="no Chromium on this machine")
@pytest.mark.parametrize(
    ("view", "extra", "suffix", "changes"),
    [
        (
            "webgl",
            (),
            "",
            {"things": (Shape(0, "box", (0.2, 0.2, 0.2), (1.0, 0.0, 0.2)),), "lost": (1.2,)},
        ),
        ("2d", ("--disable-3d-apis",), "", {}),
        (
            "2d",
            (),
            "#2d,overlaid",
            {
                "force": None,
                "torque": None,
                "contacts": None,
                "score": {},
                "curve": {},
                "things": _BOX,
            },
        ),
    ],
)
def test_page_runs_in_chromium(
    tmp_path: Path, view: str, extra: tuple[str, ...], suffix: str, changes: dict
):
    path = tmp_path / "a report.html"
    path.write_text(render(make_report(41, **changes)).replace("</body>", _PROBE), encoding="utf-8")
    assert _CHROMIUM
    done = subprocess.run(
        [_CHROMIUM, *_FLAGS, *extra, f"--user-data-dir={tmp_path / 'profile'}", path.as_uri() + suffix],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    root = re.search(r"<html[^>]*>", done.stdout)
    assert root, done.stderr[-2000:]
    if view == "webgl" and 'data-view="2d"' in root[0]:
        pytest.skip("this Chromium has no WebGL")
    assert 'data-status="ready"' in root[0] and "data-error" not in root[0], root[0]
    assert f'data-view="{view}"' in root[0]
    over = "false" if "overlaid" in suffix else "true"
    seen = re.search(r'data-seen="([^"]*)"', root[0])
    # A second before the loss, or where it was.
    at = "7 / 41" if "lost" in changes else "23 / 41"
    assert seen and seen[1] == f"Play|21 / 41|23 / 41|{over}|{at}", root[0]
