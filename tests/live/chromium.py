"""A page in headless Chromium, driven by its DevTools protocol."""

from __future__ import annotations

import base64
import contextlib
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

CHROMIUM = next(
    (p for n in ("chromium", "chromium-browser", "google-chrome", "chrome") if (p := shutil.which(n))),
    None,
)
_FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--use-gl=angle",
    "--use-angle=swiftshader", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--remote-debugging-port=0",
)  # fmt: skip


class Page:
    """One page."""

    def __init__(self, socket: Any):
        self._socket, self._id = socket, 0
        self.errors: list[str] = []

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self._id += 1
        self._socket.send(json.dumps({"id": self._id, "method": method, "params": params}))
        while True:
            told = json.loads(self._socket.recv(timeout=60))
            if told.get("method") == "Runtime.exceptionThrown":
                said = told["params"]["exceptionDetails"]
                self.errors.append(said.get("exception", {}).get("description") or said.get("text", "?"))
            if told.get("id") == self._id:
                assert "error" not in told, told
                return told["result"]

    def js(self, expression: str) -> Any:
        told = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in told, told
        return told["result"].get("value")

    def until(self, expression: str, seconds: float = 30.0) -> Any:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if value := self.js(expression):
                return value
            time.sleep(0.1)
        raise AssertionError(f"never: {expression}; {self.js('document.body.innerText')}")

    def mouse(self, kind: str, x: float, y: float) -> None:
        self.call(
            "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1
        )

    def size(self, width: int, height: int, scale: float = 1.0) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale,
            mobile=width < 640,
        )  # fmt: skip

    def shot(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))


@contextlib.contextmanager
def opened(url: str, profile: Path) -> Iterator[Page]:
    """The page at `url`."""
    assert CHROMIUM
    with subprocess.Popen(
        [CHROMIUM, *_FLAGS, f"--user-data-dir={profile}", "about:blank"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    ) as process:  # fmt: skip
        try:
            where = profile / "DevToolsActivePort"
            end = time.monotonic() + 60
            while not (where.exists() and where.read_text().strip()) and time.monotonic() < end:
                time.sleep(0.1)
            port = where.read_text().split()[0]
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=30) as told:
                door = next(t for t in json.load(told) if t["type"] == "page")["webSocketDebuggerUrl"]
            with connect(door, max_size=None, open_timeout=30) as socket:
                page = Page(socket)
                for what in ("Runtime", "Page"):
                    page.call(f"{what}.enable")
                page.size(1280, 800)
                page.call("Page.navigate", url=url)
                yield page
        finally:
            process.terminate()
            process.wait(20)
