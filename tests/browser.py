"""Debian's Chromium without a screen, driven over its DevTools protocol: pages as a reader's browser shows them."""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

REQUIRED = "LEAFFLOW_TI_REQUIRE_CHROMIUM"
OPTIONS = (
    "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-background-networking", "--disable-component-update", "--no-first-run", "--hide-scrollbars",
    "--disable-dev-shm-usage", "--remote-debugging-port=0", "--remote-allow-origins=*",
)  # fmt: skip
WAIT_S = 60.0


class Page:
    """One open page. ``requests``: addresses that it asked for; ``complaints``: its errors and warnings."""

    def __init__(self, address: str):
        from websocket import create_connection

        self._socket = create_connection(address, timeout=WAIT_S)
        self._numbers = itertools.count(1)
        self.requests: list[str] = []
        self.complaints: list[str] = []
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One command of the protocol; AssertionError where it fails."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv())
            if message.get("id") == number:
                assert "error" not in message, message["error"]
                return message["result"]
            self._note(message.get("method", ""), message.get("params", {}))

    def _note(self, event: str, said: dict[str, Any]) -> None:
        if event == "Network.requestWillBeSent" and not said["request"]["url"].startswith("data:"):
            self.requests.append(said["request"]["url"])
        elif event == "Runtime.exceptionThrown":
            self.complaints.append(said["exceptionDetails"].get("exception", {}).get("description", str(said)))
        elif event == "Log.entryAdded" and said["entry"]["level"] in ("error", "warning"):
            self.complaints.append(f"{said['entry']['text']} {said['entry'].get('url', '')}")
        elif event == "Runtime.consoleAPICalled" and said["type"] in ("error", "warning", "assert"):
            self.complaints.append(str([a.get("value", a.get("description")) for a in said["args"]]))

    def open(self, path: Path, width: int = 1200, height: int = 900, dark: bool = False, touch: bool = False) -> None:
        """Load a file, without network, on a screen of this size, until ``wait``'s first condition can be asked."""
        self.call("Network.emulateNetworkConditions", offline=True, latency=0, downloadThroughput=0, uploadThroughput=0)
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=touch)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        self.requests.clear()
        self.call("Page.navigate", url=path.resolve().as_uri())
        self.until("document.readyState === 'complete' && location.protocol === 'file:'")

    def ask(self, expression: str) -> Any:
        """Value of a JavaScript expression, promises awaited."""
        found = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def until(self, condition: str) -> None:
        """Wait for a condition to become true; AssertionError after ``WAIT_S``."""
        end = time.monotonic() + WAIT_S
        while not self.ask(f"Boolean({condition})"):
            assert time.monotonic() < end, f"still not true: {condition}; {self.complaints}"
            time.sleep(0.05)

    def drag(self, x: float, y: float, dx: float, dy: float) -> None:
        """Press the mouse at a point of the window, move it, let go."""
        points = {"mousePressed": (x, y), "mouseMoved": (x + dx, y + dy), "mouseReleased": (x + dx, y + dy)}
        for kind, (at_x, at_y) in points.items():
            options = {"button": "left", "buttons": 1, "clickCount": 1}
            self.call("Input.dispatchMouseEvent", type=kind, x=at_x, y=at_y, **options)

    def press(self, key: str) -> None:
        """A key, by its name in JavaScript."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key)

    def picture(self, whole: bool = False) -> bytes:
        """What the window, or the whole page, shows as a PNG file."""
        found = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        return base64.b64decode(found["data"])

    def close(self) -> None:
        self._socket.close()


@contextlib.contextmanager
def chromium() -> Iterator[Page]:
    """A page in a browser of its own; the test is skipped where there is no Chromium, and fails where it must be."""
    program = shutil.which("chromium")
    if program is None and os.environ.get(REQUIRED) != "1":
        pytest.skip("Chromium is not installed")
    assert program is not None, f"Chromium is not installed, and {REQUIRED}=1 asks for it"
    pytest.importorskip("websocket", reason="websocket-client is not installed")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile, subprocess.Popen(
        [program, *OPTIONS, f"--user-data-dir={profile}", "about:blank"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    ) as browser:  # fmt: skip
        try:
            page = Page(_address(Path(profile), browser))
            yield page
            page.close()
        finally:
            browser.terminate()
            browser.wait(WAIT_S)


def _address(profile: Path, browser: subprocess.Popen[bytes]) -> str:
    """The page's address for the protocol, once the browser has opened its port."""
    import urllib.request

    note, end = profile / "DevToolsActivePort", time.monotonic() + WAIT_S
    while not note.exists() or len(note.read_text().split()) < 2:
        assert browser.poll() is None, f"Chromium ended with {browser.returncode}"
        assert time.monotonic() < end, "Chromium opened no port"
        time.sleep(0.05)
    port = note.read_text().split()[0]
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=WAIT_S) as answer:
        pages = [target for target in json.load(answer) if target["type"] == "page"]
    return str(pages[0]["webSocketDebuggerUrl"])


def pixels_of(picture: bytes) -> np.ndarray:
    """A PNG file as grey values, [y, x, 3]."""
    import io

    from PIL import Image

    with Image.open(io.BytesIO(picture)) as image:
        return np.asarray(image.convert("RGB"))
