"""Runs a wire daemon as a child process, for tests and benches."""

from __future__ import annotations

import os
import select
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from runtime.errors import LinkError

_START_TIMEOUT_S: Final = 20.0
_STOP_TIMEOUT_S: Final = 5.0


@contextmanager
def wire_daemon(
    buses: Mapping[str, int], directory: Path | None = None, joined: Mapping[str, str] | None = None
) -> Iterator[subprocess.Popen[str]]:
    """Run a daemon that serves `buses` (name to bit/s), ready for clients; it ends with the block.

    `joined` maps SocketCAN interfaces to the bus that they join.

    Raises:
        LinkError: the daemon does not start; the sentence is the daemon's own.
    """
    ready, child_end = os.pipe()
    command = [sys.executable, "-m", "hil.wire.daemon", "--ready-fd", str(child_end)]
    for name, bitrate in buses.items():
        command += ["--bus", f"{name}:{bitrate}"]
    for interface, name in (joined or {}).items():
        command += ["--join", f"{name}={interface}"]
    if directory is not None:
        command += ["--dir", str(directory)]
    process = subprocess.Popen(
        command, pass_fds=[child_end], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    os.close(child_end)
    try:
        if not select.select([ready], [], [], _START_TIMEOUT_S)[0] or not os.read(ready, 16):
            process.kill()
            sentence = process.communicate()[1].strip() or "The wire daemon did not start."
            raise LinkError("wire.not-started", sentence)
        yield process
    finally:
        os.close(ready)
        process.terminate()
        try:
            process.communicate(timeout=_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
