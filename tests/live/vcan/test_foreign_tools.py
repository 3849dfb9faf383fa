"""The commands of docs/how-to/can0.md, as they stand there, on vcan0: candump, cansend, python-can's logger and viewer.

Frames of the real codec go out meanwhile, so that every tool shows what a user would see.
"""

from __future__ import annotations

import contextlib
import os
import pty
import re
import select
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from can_dbc.bus.factory import open_bus
from can_dbc.frame import Frame

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs/how-to/can0.md"
TIMEOUT_S = 30.0
COMMAND, ENCODER, OTHER = 0x210, 0x182, 0x181
DATA = bytes.fromhex("0123456789ABCDEF")


def commands(program: str) -> list[list[str]]:
    """The lines of the page that begin with ``program``, for vcan0 and this interpreter."""
    found = re.findall(rf"^    ({re.escape(program)}.*)$", PAGE.read_text(), re.MULTILINE)
    assert found, f"{PAGE.name} names no {program}"
    words = [shlex.split(line.replace("can0", "vcan0")) for line in found]
    return [[sys.executable, *line[1:]] if line[0] == "python" else line for line in words]


def require(tool: str) -> None:
    if shutil.which(tool) is None:
        pytest.skip(f"{tool} is missing (apt-get install can-utils)")


@contextlib.contextmanager
def sender() -> Iterator[None]:
    """Frames on vcan0 until the end, from another process: a tool may block this one."""
    script = (
        "import time\nfrom can_dbc.bus.factory import open_bus\nwith open_bus('socketcan:vcan0') as bus:\n"
        f"    while True:\n        for key in ({OTHER}, {COMMAND}, {ENCODER}):\n            bus.send(key, {DATA!r})\n"
        "        time.sleep(0.02)"
    )
    process = subprocess.Popen([sys.executable, "-c", script], cwd=ROOT)
    try:
        yield
    finally:
        process.kill()
        process.wait()


def test_candump_shows_every_frame_and_the_chosen_ones() -> None:
    require("candump")
    everything, chosen = commands("candump")
    with sender():
        lines = subprocess.run(everything, capture_output=True, text=True, timeout=TIMEOUT_S, check=True).stdout
        assert len(lines.splitlines()) == 20
        assert {line.split()[1] for line in lines.splitlines()} == {"181", "182", "210"}
        lines = subprocess.run(chosen, capture_output=True, text=True, timeout=TIMEOUT_S, check=True).stdout
    assert {line.split()[2] for line in lines.splitlines()} == {
        f"210#{DATA.hex().upper()}",
        f"182#{DATA.hex().upper()}",
    }


def test_cansend_reaches_our_bus() -> None:
    require("cansend")
    (command,) = commands("cansend")
    with open_bus("socketcan:vcan0") as bus:
        subprocess.run(command, check=True, timeout=TIMEOUT_S)
        frames: list[Frame] = []
        deadline = time.monotonic() + TIMEOUT_S
        while not frames and time.monotonic() < deadline:
            bus.drain(frames)
            time.sleep(0.01)
    assert [(frame.key, frame.data) for frame in frames] == [(0x7EF, DATA)]


def test_the_logger_of_python_can_writes_a_log_that_we_read(tmp_path: Path) -> None:
    (command,) = commands("python -m can.logger")
    log = tmp_path / command[-1]
    with sender():
        logger = subprocess.Popen([*command[:-1], str(log)], stdout=subprocess.DEVNULL)
        deadline = time.monotonic() + TIMEOUT_S
        while not (log.exists() and log.stat().st_size > 2000):
            assert logger.poll() is None and time.monotonic() < deadline, "the logger writes nothing"
            time.sleep(0.05)
        logger.send_signal(signal.SIGINT)
        logger.wait(TIMEOUT_S)
    frames = list(can.LogReader(str(log)))
    assert {frame.arbitration_id for frame in frames} == {OTHER, COMMAND, ENCODER}
    assert all(bytes(frame.data) == DATA for frame in frames)


def test_the_viewer_of_python_can_shows_the_frames() -> None:
    (command,) = commands("python -m can.viewer")
    pid, screen = pty.fork()
    if pid == 0:
        os.environ |= {"TERM": "xterm", "LINES": "40", "COLUMNS": "120"}
        os.execv(command[0], command)
    shown, deadline = b"", time.monotonic() + TIMEOUT_S
    try:
        with sender():
            while not (b"210" in shown and b"182" in shown):
                assert time.monotonic() < deadline, shown.decode(errors="replace")[-2000:]
                if select.select([screen], [], [], 0.2)[0]:
                    shown += os.read(screen, 65536)
            os.write(screen, b"q")
            status = None
            while status is None and time.monotonic() < deadline:
                if select.select([screen], [], [], 0.1)[0]:
                    with contextlib.suppress(OSError):
                        os.read(screen, 65536)
                ended, code = os.waitpid(pid, os.WNOHANG)
                status = code if ended else None
        assert status == 0
    finally:
        with contextlib.suppress(ProcessLookupError, ChildProcessError):
            if os.waitpid(pid, os.WNOHANG)[0] == 0:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
        os.close(screen)
