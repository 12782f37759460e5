"""The page of live motion in browsers: seconds until something moves, frames a second, a picture.

    python benchmarks/live_page.py chromium --minutes 5 --picture OUT.png --json OUT.json
    xvfb-run python benchmarks/live_page.py firefox --minutes 0 --picture OUT.png --json OUT.json

`poise live` starts in a process of its own with the walk that it plays by default, and a headless
browser that draws without a graphics card opens its page. The first second counts from the start of
the process, not of an installation. Times are of the machine as it was.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from speed import machine
from websockets.sync.client import connect

from live import serve

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "live"))
from chromium import opened

#: What a page is asked: what the first character does, its place on the screen's canvas, and figures.
ASKS = """JSON.stringify({
  doing: document.body?.dataset.doing ?? "", status: document.body?.dataset.status ?? "",
  hz: Number(document.getElementById("hz")?.textContent),
  fps: Number(document.getElementById("fps")?.textContent),
  at: window.poiseLive?.state?.bodies ? Array.from(poiseLive.state.bodies).slice(0, 3) : null,
})"""
#: What has Firefox draw WebGL without a graphics card.
PREFS = {"webgl.force-enabled": True, "webgl.out-of-process": False, "gfx.webrender.software": True}
#: m that the pelvis has moved when a character moves; s that are waited for it.
MOVED_M, WAITS_S = 0.3, 300.0


@contextlib.contextmanager
def firefox(url: str, profile: Path) -> Iterator[tuple[Callable[[str], Any], Callable[[Path], None]]]:
    """What runs scripts in a page of Firefox and what takes its picture, by WebDriver BiDi."""
    prefs = [f'user_pref("{k}", {json.dumps(v)});\n' for k, v in PREFS.items()]
    (profile / "user.js").write_text("".join(prefs))
    # Without a window Firefox has no WebGL on machines without a graphics card; a display that Xvfb
    # makes will do.
    headless = () if os.environ.get("DISPLAY") else ("--headless",)
    with subprocess.Popen(
        ["firefox-esr", *headless, "--no-remote", "--profile", str(profile),
         "--remote-debugging-port", "0", "--window-size", "1280,800"],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "LIBGL_ALWAYS_SOFTWARE": "1"},
    ) as process:  # fmt: skip
        try:
            assert process.stderr is not None
            lines = (re.search(r"ws://\S+", line) for line in process.stderr)
            door = next(found[0] for found in lines if found)
            with connect(f"{door}/session", max_size=None, open_timeout=60) as socket:
                count = 0

                def call(method: str, **params: Any) -> dict[str, Any]:
                    nonlocal count
                    count += 1
                    socket.send(json.dumps({"id": count, "method": method, "params": params}))
                    while True:
                        told = json.loads(socket.recv(timeout=600))
                        if told.get("id") == count:
                            if "result" not in told:
                                raise SystemExit(f"{method}: {told}")
                            return told["result"]

                call("session.new", capabilities={})
                page = call("browsingContext.getTree")["contexts"][0]["context"]
                call("browsingContext.navigate", context=page, url=url, wait="complete")

                def js(expression: str) -> Any:
                    told = call(
                        "script.evaluate", expression=expression, target={"context": page},
                        awaitPromise=False,
                    )  # fmt: skip
                    return told["result"].get("value")

                def shot(path: Path) -> None:
                    data = call("browsingContext.captureScreenshot", context=page)["data"]
                    path.write_bytes(base64.b64decode(data))

                yield js, shot
        finally:
            process.terminate()
            process.wait(20)


@contextlib.contextmanager
def chromium(url: str, profile: Path) -> Iterator[tuple[Callable[[str], Any], Callable[[Path], None]]]:
    """The same for Chromium."""
    with opened(url, profile) as page:
        yield page.js, page.shot


def watched(browser: str, minutes: float, picture: Path) -> dict[str, Any]:
    """One browser."""
    began = time.perf_counter()
    process, host = serve("--seconds", str(WAITS_S + 60 * minutes + 60))
    row: dict[str, Any] = {"machine": machine(), "served_s": round(time.perf_counter() - began, 1)}
    opens = {"chromium": chromium, "firefox": firefox}[browser]
    try:
        with (
            tempfile.TemporaryDirectory() as folder,
            opens(f"http://{host}/", Path(folder)) as (js, shot),
        ):
            first, end = None, began + WAITS_S
            while time.perf_counter() < end:
                told = json.loads(js(ASKS))
                if told["at"] is not None:
                    first = told["at"] if first is None else first
                    if np.linalg.norm(np.subtract(told["at"], first)) > MOVED_M:
                        row["moves_s"] = round(time.perf_counter() - began, 1)
                        break
                time.sleep(0.1)
            seen, end = list[dict[str, Any]](), time.perf_counter() + max(5.0, 60 * minutes)
            while time.perf_counter() < end:
                time.sleep(1.0)
                seen.append(json.loads(js(ASKS)))
            shot(picture)
    finally:
        process.terminate()
        process.wait(30)
    for name in ("fps", "hz"):
        values = [s[name] for s in seen if s[name] is not None]
        row[name] = {
            "median": round(float(np.median(values)), 1), "least": round(float(np.min(values)), 1)
        }  # fmt: skip
    return {**row, "minutes": minutes, "status": seen[-1]["status"], "doing": seen[-1]["doing"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("browser", choices=("chromium", "firefox"))
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--picture", type=Path, required=True)
    parser.add_argument("--json", type=Path, required=True)
    o = parser.parse_args()
    out = json.loads(o.json.read_text()) if o.json.exists() else {}
    out[o.browser] = watched(o.browser, o.minutes, o.picture)
    o.json.write_text(json.dumps(out, indent=1) + "\n")
    print(json.dumps(out[o.browser]), flush=True)


if __name__ == "__main__":
    main()
