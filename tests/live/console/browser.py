"""A headless Chromium, driven over its DevTools protocol: the content of a page, and clicks on it."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple, Self

from websockets.sync.client import connect

from tests.live.console.entries import entered

NAMES = ("chromium", "chromium-headless-shell", "chromium-browser", "google-chrome")
MISSING = "needs chromium: sudo apt-get install chromium"
PATIENCE_S = 30.0


def installed() -> str | None:
    """The browser's program, if there is one."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Memory(NamedTuple):
    """What a page holds."""

    heap_bytes: int
    nodes: int
    listeners: int


class Browser:
    """One page of one size; ``light`` as a person prefers it; ``solid``: with WebGL, which costs a processor."""

    def __init__(
        self, folder: Path, size: tuple[int, int] = (1366, 768), light: bool = False, solid: bool = False
    ) -> None:
        program = installed()
        assert program is not None, MISSING
        folder.mkdir(exist_ok=True)
        self._said = (folder / "chromium.err").open("wb")
        options = (
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--no-first-run",
            "--enable-unsafe-swiftshader" if solid else "--disable-3d-apis",
            "--remote-debugging-port=0",
            f"--user-data-dir={folder / 'chromium'}",
            f"--window-size={size[0]},{size[1]}",
        )
        self._sockets = tempfile.TemporaryDirectory(prefix="timberhand-browser-")  # it leaves its socket there
        self._process = subprocess.Popen(
            [program, *options, "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=self._said,
            env=os.environ | {"TMPDIR": self._sockets.name},
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

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End it."""
        self._open.close()
        self._process.terminate()
        self._process.wait(10)
        self._said.close()
        self._sockets.cleanup()

    def open(self, url: str, enters: bool = True) -> None:
        """Load a page, by the printed address if it ``enters``."""
        self._ask("Page.navigate", url=entered(url) if enters else url)
        self.until("document.readyState === 'complete' && location.protocol === 'http:'")

    def draw_every(self, period_ms: int) -> None:
        """Pages that are opened from now on draw so seldom: what software renders takes the processor from scripts."""
        script = f"window.requestAnimationFrame = f => setTimeout(() => f(performance.now()), {period_ms});"
        self._ask("Page.enable")
        self._ask("Page.addScriptToEvaluateOnNewDocument", source=script)

    def value(self, script: str) -> Any:
        """What an expression of the page is worth; raises AssertionError when it throws."""
        answer = self._ask("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def text(self, element: str) -> str:
        """The words in an element; empty when they are not to be seen."""
        return str(self.value(f"(e => e?.checkVisibility() ? e.innerText : '')(document.getElementById({element!r}))"))

    def click(self, element: str) -> None:
        """A real click on its centre, when the page no longer moves it; an element that covers it gets it."""
        box = self.value(
            f"(async () => {{ const e = document.getElementById({element!r}); let last;"
            " for (let still = 0; still < 3; await new Promise(done => setTimeout(done, 30))) {"
            " e.scrollIntoView({block: 'center'}); const b = e.getBoundingClientRect();"
            " const now = [b.x + b.width / 2, b.y + b.height / 2]; still = `${now}` === `${last}` ? still + 1 : 0;"
            " last = now; } return last; })()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self._ask("Input.dispatchMouseEvent", type=kind, x=box[0], y=box[1], button="left", clickCount=1)

    def click_on(self, selector: str, words: str) -> None:
        """A real click on the first element of a selector whose text begins with words."""
        found = f"[...document.querySelectorAll({selector!r})].find(e => e.innerText.startsWith({words!r}))"
        self.until(f"Boolean({found})")
        x, y = self.value(
            f"(e => {{ e.scrollIntoView({{block: 'center'}}); const b = e.getBoundingClientRect();"
            f" return [b.x + b.width / 2, b.y + b.height / 2]; }})({found})"
        )
        self.press(x, y)

    def mouse(self, kind: str, x: float, y: float, count: int = 1) -> None:
        """A real event at a place of the window: "mousePressed", "mouseReleased" or "mouseMoved" (with the button)."""
        self._ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=count)

    def press(self, x: float, y: float, count: int = 1) -> None:
        """A real click at a place of the window."""
        self._ask("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, count)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """A real drag, in steps as a hand makes them."""
        self._ask("Input.dispatchMouseEvent", type="mouseMoved", x=start[0], y=start[1])
        self.mouse("mousePressed", *start)
        for k in range(1, 6):
            self.mouse("mouseMoved", *(a + (b - a) * k / 5 for a, b in zip(start, end, strict=True)))
        self.mouse("mouseReleased", *end)

    def keys(self, text: str) -> None:
        """Type a text where the focus is, or press one key by its name, as in "Enter"."""
        if len(text) > 1 and text.isalpha():
            for kind in ("rawKeyDown", "keyUp"):
                self._ask("Input.dispatchKeyEvent", type=kind, key=text, code=text)
        else:
            self._ask("Input.insertText", text=text)

    def choose_file(self, element: str, file: Path) -> None:
        """Choose a file in a file input."""
        found = self._ask("Runtime.evaluate", expression=f"document.getElementById({element!r})")["result"]["objectId"]
        self._ask("DOM.setFileInputFiles", files=[str(file)], objectId=found)

    def memory(self) -> Memory:
        """What the page holds after a forced collection: the least of three readings."""
        self._ask("Performance.enable")
        found = []
        for _ in range(3):
            self._ask("HeapProfiler.collectGarbage")
            told = {each["name"]: int(each["value"]) for each in self._ask("Performance.getMetrics")["metrics"]}
            found.append(Memory(told["JSHeapUsedSize"], told["Nodes"], told["JSEventListeners"]))
            time.sleep(0.3)
        return Memory(*(min(values) for values in zip(*found, strict=True)))

    def picture(self, path: Path) -> None:
        """Save a screenshot as PNG."""
        path.write_bytes(base64.b64decode(self._ask("Page.captureScreenshot", format="png")["data"]))

    def until(self, script: str) -> Any:
        """Wait until an expression is true; its value."""
        return self.wait(lambda: self.value(script), script)

    def shows(self, element: str, words: str) -> None:
        """Wait until an element shows words; raises AssertionError with what it shows instead."""
        self.wait(lambda: words in self.text(element), lambda: f"{element}: {words}, not {self.text(element)}")

    @staticmethod
    def wait(so: Callable[[], Any], what: str | Callable[[], str]) -> Any:
        """Wait until something is so; raises AssertionError after ``PATIENCE_S`` with ``what`` is awaited, or what a
        call says then.
        """
        limit = time.monotonic() + PATIENCE_S
        while not (value := so()):
            assert time.monotonic() < limit, what if isinstance(what, str) else what()
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
