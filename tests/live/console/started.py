"""Commands started as a person starts them in a folder, their pages in a browser, and pictures of these for the docs.

With ``TIMBERHAND_PICTURES`` set, `keep` writes into docs.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Self

from PIL import Image

from tests.live.console.browser import Browser
from tests.live.console.entries import note

ROOT = Path(__file__).parents[3]
TUTORIAL = ROOT / "docs" / "tutorial"
SIZE = (1280, 800)
START_S = 300.0
"""So long a busy computer may take to start a page."""
SOLID_S = 25.0
"""So long a page with WebGL may take to draw in software."""


def pictured() -> bool:
    """Whether this run makes the pictures of the documentation."""
    return bool(os.environ.get("TIMBERHAND_PICTURES"))


class Started:
    """A command in its folder, with a wire of its own; ``url`` is the page that it opens on the port of ``option``."""

    def __init__(self, folder: Path, module: str, *arguments: str, option: str = "--port") -> None:
        self.said = folder / f"{module}-{'-'.join(arguments[:1])}.out"
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        wire = folder / ".wire"
        wire.mkdir(exist_ok=True)
        environment = os.environ | {"PYTHONPATH": str(ROOT), "TIMBERHAND_WIRE_DIR": str(wire)}
        with self.said.open("wb") as out:
            self.process = subprocess.Popen(
                [sys.executable, "-m", module, *arguments, option, str(port)],
                cwd=folder,
                stdout=out,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                env=environment,
            )
        self.url = f"http://127.0.0.1:{port}/"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.interrupt()

    def answers(self) -> bool:
        """Whether the page is served and its address is printed.

        Raises:
            AssertionError: the command has ended, with what it said.
        """
        assert self.process.poll() is None, self.said.read_text()
        with contextlib.suppress(OSError), urllib.request.urlopen(f"{self.url}static/icon.svg", timeout=20) as answer:
            printed = re.search(rf"({self.url}(?:\?[^\s\"]+)?)[\s\"]", self.said.read_text())
            if printed:
                note(printed[1])
            return answer.status == 200 and printed is not None
        return False

    def interrupt(self) -> None:
        """Ctrl-C; the command has a minute to end."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            self.process.wait(60)


def opened(started: Started, browser: Browser, path: str = "") -> None:
    """Open a page of a command when it is served."""
    limit = time.monotonic() + START_S
    while not started.answers():
        assert time.monotonic() < limit, started.said.read_text()
        time.sleep(0.2)
    browser.open(started.url + path)


def keep(browser: Browser, path: Path) -> None:
    """A picture for the docs, with few colours: they are kept in the repository."""
    if not pictured():
        return
    path.parent.mkdir(exist_ok=True)
    browser.value("scrollTo(0, 0)")
    browser.picture(path)
    Image.open(path).convert("RGB").quantize(96, dither=Image.Dither.NONE).save(path, optimize=True)
