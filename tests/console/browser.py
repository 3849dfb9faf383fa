"""A headless Chromium, driven over its DevTools protocol: the content of a page, and clicks on it."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

NAMES = ("chromium", "chromium-headless-shell", "chromium-browser", "google-chrome")
MISSING = "needs chromium: sudo apt-get install chromium"
PATIENCE_S = 30.0


def installed() -> str | None:
    """The browser's program, if there is one."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One page of one size; ``light`` as a person prefers it; ``solid``: with WebGL, which costs a processor."""

    def __init__(
        self, folder: Path, size: tuple[int, int] = (1366, 768), light: bool = False, solid: bool = False
    ) -> None:
        program = installed()
        assert program is not None, MISSING
        self._said = (folder / "chromium.err").open("wb")
        options = (
            "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
            "--enable-unsafe-swiftshader" if solid else "--disable-3d-apis", "--remote-debugging-port=0",
            f"--user-data-dir={folder / 'chromium'}", f"--window-size={size[0]},{size[1]}",
        )  # fmt: skip
        self._process = subprocess.Popen(
            [program, *options, "about:blank"], stdout=subprocess.DEVNULL, stderr=self._said
        )
        self._number = 0
        port = folder / "chromium" / "DevToolsActivePort"
        self.wait(lambda: port.exists() and port.read_text().count("\n") >= 1, "the browser does not start")
        number, path = port.read_text().split()
        self._open = ExitStack()
        self._link = self._open.enter_context(
            connect(f"ws://127.0.0.1:{number}{path}", max_size=None, compression=None)
        )
        self._session = None
        target = self._ask("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        wide, high = size
        self._ask("Emulation.setDeviceMetricsOverride", width=wide, height=high, deviceScaleFactor=1, mobile=False)
        scheme = {"name": "prefers-color-scheme", "value": "light" if light else "dark"}
        self._ask("Emulation.setEmulatedMedia", features=[scheme])

    def close(self) -> None:
        """End it."""
        self._open.close()
        self._process.terminate()
        self._process.wait(10)
        self._said.close()

    def open(self, url: str) -> None:
        """Load a page."""
        self._ask("Page.navigate", url=url)
        self.until("document.readyState === 'complete' && location.protocol === 'http:'")

    def value(self, script: str) -> Any:
        """What an expression of the page is worth; raises AssertionError when it throws."""
        answer = self._ask("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def text(self, element: str) -> str:
        """The words in an element; empty when they are not to be seen."""
        return str(self.value(f"(e => e?.checkVisibility() ? e.innerText : '')(document.getElementById({element!r}))"))

    def click(self, element: str) -> None:
        """A real click on its centre; an element that covers it receives the click."""
        box = self.value(
            f"(() => {{ const e = document.getElementById({element!r}); e.scrollIntoView({{block: 'center'}});"
            " const b = e.getBoundingClientRect(); return [b.x + b.width / 2, b.y + b.height / 2]; })()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self._ask("Input.dispatchMouseEvent", type=kind, x=box[0], y=box[1], button="left", clickCount=1)

    def picture(self, path: Path) -> None:
        """Save a screenshot as PNG."""
        path.write_bytes(base64.b64decode(self._ask("Page.captureScreenshot", format="png")["data"]))

    def until(self, script: str) -> Any:
        """Wait until an expression is true; its value."""
        return self.wait(lambda: self.value(script), script)

    @staticmethod
    def wait(so: Callable[[], Any], what: str) -> Any:
        """Wait until something is so; raises AssertionError after ``PATIENCE_S``."""
        limit = time.monotonic() + PATIENCE_S
        while not (value := so()):
            assert time.monotonic() < limit, what
            time.sleep(0.05)
        return value

    def _ask(self, method: str, **told: Any) -> dict[str, Any]:
        self._number += 1
        message = {"id": self._number, "method": method, "params": told}
        if self._session is not None:
            message["sessionId"] = self._session
        self._link.send(json.dumps(message))
        while True:
            answer = json.loads(self._link.recv(PATIENCE_S))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return dict(answer["result"])
