"""A headless Chromium, driven by its DevTools protocol: pages that need a running server."""

from __future__ import annotations

import base64
import functools
import itertools
import json
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

__all__ = ["Browser", "chromium"]

PATIENCE = 60.0
"""Seconds that a loaded machine is given for anything."""


@functools.cache
def chromium() -> str | None:
    """The browser of this machine, or None."""
    names = ("chromium", "chromium-browser", "chrome", "google-chrome")
    return next(filter(None, map(shutil.which, names)), None)


class Browser:
    """One page of a headless Chromium; a context manager.

    :ivar errors: what the page logged as errors, and exceptions that it did not catch.
    :ivar requested: the URLs of every request.
    """

    def __init__(self, folder: Path, width: int = 1400, height: int = 900) -> None:
        from websockets.sync.client import connect

        browser = chromium()
        assert browser is not None
        self.errors: list[str] = []
        self.requested: list[str] = []
        profile = folder / "profile"
        self._process = subprocess.Popen(
            [
                browser,
                "--headless",
                "--no-sandbox",
                "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
                "--disable-quic",
                "--no-first-run",
                "--disable-background-networking",
                "--disable-component-update",
                "--hide-scrollbars",
                "--remote-debugging-port=0",
                f"--user-data-dir={profile}",
                f"--window-size={width},{height}",
                "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        port = self._wait_for(profile / "DevToolsActivePort").split("\n")[0]
        self._numbers = itertools.count(1)
        self._socket = connect(self._target(int(port)), max_size=64 * 2**20)
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def _wait_for(self, file: Path) -> str:
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            assert self._process.poll() is None, "chromium has ended"
            if file.exists() and (text := file.read_text()):
                return text
            time.sleep(0.02)
        raise AssertionError("chromium does not answer")

    @staticmethod
    def _target(port: int) -> str:
        from http.client import HTTPConnection

        connection = HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
        connection.request("GET", "/json")
        targets = json.loads(connection.getresponse().read())
        connection.close()
        return str(next(t for t in targets if t["type"] == "page")["webSocketDebuggerUrl"])

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *exc: object) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait(PATIENCE)

    def call(self, method: str, **parameters: object) -> dict[str, Any]:
        """Call a method of the DevTools protocol; its result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=PATIENCE))
            if message.get("id") == number:
                assert "error" not in message, message
                return dict(message["result"])
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        what, told = message.get("method"), message.get("params", {})
        if what == "Network.requestWillBeSent":
            self.requested.append(told["request"]["url"])
        elif what == "Network.webSocketCreated":
            self.requested.append(told["url"])
        elif what == "Runtime.exceptionThrown":
            self.errors.append(str(told["exceptionDetails"].get("text")))
        elif what == "Log.entryAdded" and told["entry"]["level"] == "error":
            self.errors.append(told["entry"]["text"] + " " + told["entry"].get("url", ""))

    def open(self, url: str) -> None:
        """Go to a page."""
        self.call("Page.navigate", url=url)

    def run(self, expression: str) -> Any:
        """The value of a JavaScript expression."""
        found = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        return found["result"].get("value")

    def wait(self, expression: str) -> Any:
        """Wait until an expression is true; its value."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            if value := self.run(expression):
                return value
            time.sleep(0.05)
        text = self.run("document.body ? document.body.innerText : ''")
        raise AssertionError(f"never true: {expression}\nthe page says: {text}")

    def click(self, text: str) -> None:
        """Click with the mouse on the last button or tab whose text begins so, when it is seen."""
        find = (
            "(() => { const found = [...document.querySelectorAll('button,[role=tab],label')]"
            f".filter(e => e.innerText.trim().startsWith({json.dumps(text)})).pop();"
            "if (!found) return null; found.scrollIntoView({block: 'center'});"
            "const box = found.getBoundingClientRect();"
            "const x = box.x + box.width / 2, y = box.y + box.height / 2;"
            "return found.contains(document.elementFromPoint(x, y)) ? [x, y] : null; })()"
        )
        before, place = None, self.wait(find)
        while place != before:  # the page may still be arranging itself
            time.sleep(0.05)
            before, place = place, self.wait(find)
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            self.call(
                "Input.dispatchMouseEvent",
                type=kind,
                x=place[0],
                y=place[1],
                button="left",
                clickCount=1,
            )

    def picture(self) -> bytes:
        """The page as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
