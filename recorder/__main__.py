"""``python -m recorder``: records buses, tick records, state reports and timing until SIGTERM or SIGINT.

The receiving thread only takes and queues, the writing thread only writes, so a disk that hangs for seconds costs
nothing, and one that hangs longer costs records, which are counted and told on stderr at most once a second.
When everything is open, one JSON line with ``ready`` goes to stdout.

Exit codes: 0 ended in good order, 2 usage, 3 the directory or profile cannot be used, 4 a bus or port cannot be used.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import queue
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from can_dbc.bus.base import Bus, BusError, BusState
from can_dbc.bus.batch import widen
from can_dbc.bus.factory import open_bus
from can_dbc.bus.reconnector import LostLink
from can_dbc.frame import Frame
from can_dbc.timing.page import Timing, TimingRefused, read_timing
from machine.loading.profile_file import ProfileError, load_profile
from recorder.manifest import describe
from recorder.recorder import Recorder, RecordingRefused

QUEUE_ITEMS: Final = 50_000
"""About ten seconds of two busy buses."""
FLUSH_S: Final = 0.1
LOOK_S: Final = 0.02
BATCH_BYTES: Final = 65536
TIMING_S: Final = 1.0

Item = tuple[str, str, list[Frame] | bytes | Timing]


class Shell:
    """The receiving side: what waits goes into the queue; what does not fit is counted.

    It looks every 20 ms instead of waking for every frame: stamps are the bus's own, the sockets hold far more, and a
    recorder that sleeps leaves the processor to those who are in a hurry.
    """

    def __init__(
        self, buses: dict[str, Bus], ticks: socket.socket, reports: socket.socket, timing: Path | None = None
    ) -> None:
        self.items: queue.Queue[Item | None] = queue.Queue(QUEUE_ITEMS)
        self.dropped = 0
        self._buses = tuple(buses.values())
        self.wake, self._ask = socket.socketpair()
        self._takers = [self._taker(name, bus) for name, bus in buses.items()]
        self._takers += [self._datagrams(kind, sock) for kind, sock in (("tick", ticks), ("report", reports))]
        self._takers += [self._page(timing)] if timing else []

    def run(self) -> None:
        """Receive until ``end``, and then what still waits."""
        ended = False
        while not ended:
            ended = bool(select.select([self.wake], [], [], LOOK_S)[0])
            for take in self._takers:
                take()
        self.items.put(None)

    def end(self) -> None:
        """Make ``run`` return; callable from a signal handler."""
        self._ask.send(b"x")

    @property
    def lost(self) -> int:
        """Frames and records that were there and that nobody will write: the kernel's buffer or the queue was full."""
        return self.dropped + sum(bus.stats.dropped for bus in self._buses)

    def _put(self, item: Item, count: int) -> None:
        try:
            self.items.put_nowait(item)
        except queue.Full:
            self.dropped += count

    def _taker(self, name: str, bus: Bus) -> Callable[[], None]:
        link, told = LostLink(bus), False
        lost, tell_after = 0, 0.0

        def take() -> None:
            nonlocal told, lost, tell_after
            frames: list[Frame] = []
            if bus.drain(frames):
                self._put(("frames", name, frames), len(frames))
            down = bus.stats.state is BusState.DOWN
            if down != told:
                told = down
                say(f"{name} is {'down; recording goes on when it is back' if down else 'back'}")
            if bus.stats.dropped > lost and (now := time.monotonic()) >= tell_after:
                lost, tell_after = bus.stats.dropped, now + 1.0
                say(f"{lost} frames of {name} came too fast to be recorded; give the recorder more processor time")
            link.watch(time.monotonic_ns())

        return take

    def _page(self, path: Path) -> Callable[[], None]:
        look_at, written_ns = 0.0, 0

        def take() -> None:
            nonlocal look_at, written_ns
            if (now := time.monotonic()) < look_at:
                return
            look_at = now + TIMING_S
            with contextlib.suppress(TimingRefused):  # no controller, or one that has not begun
                timing = read_timing(path)
                if timing.facts.written_ns != written_ns:
                    written_ns = timing.facts.written_ns
                    self._put(("timing", "", timing), 1)

        return take

    def _datagrams(self, kind: str, sock: socket.socket) -> Callable[[], None]:
        def take() -> None:
            try:
                while True:
                    self._put((kind, "", sock.recv(BATCH_BYTES)), 1)
            except BlockingIOError:
                pass

        return take


def write_all(recorder: Recorder, shell: Shell) -> None:
    """The writing thread: everything in the queue to the recorder, until None comes."""
    told, tell_after = 0, 0.0
    flush_at = time.monotonic() + FLUSH_S
    while True:
        try:
            item = shell.items.get(timeout=max(0.0, flush_at - time.monotonic()))
        except queue.Empty:
            item = ("", "", b"")
        if item is None:
            break
        kind, name, what = item
        if isinstance(what, list):
            for frame in what:
                recorder.on_frame(name, frame)
        elif isinstance(what, Timing):
            recorder.on_timing(what)
        elif kind == "tick":
            recorder.on_tick(what)
        elif kind == "report":
            recorder.on_report(what)
        now = time.monotonic()
        if now >= flush_at:
            recorder.flush(time.monotonic_ns())
            flush_at = time.monotonic() + FLUSH_S
        lost = recorder.dropped + shell.dropped
        if lost > told and now >= tell_after:
            say(f"{lost} records could not be written so far; make room on the disk")
            told, tell_after = lost, now + 1.0
    recorder.dropped += shell.lost
    recorder.close()


def say(sentence: str) -> None:
    """One line on stderr."""
    sys.stderr.write(f"recorder: {sentence}\n")


def udp_socket(port: int) -> socket.socket:
    """A bound, non-blocking socket on loopback; raises OSError."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setblocking(False)
    widen(sock, 4 << 20)
    sock.bind(("127.0.0.1", port))
    return sock


def main(arguments: Sequence[str] | None = None) -> int:
    """The process; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m recorder", description="Records buses, ticks and reports.")
    parser.add_argument("--out", type=Path, required=True, help="directory of the recording; it must hold none yet")
    parser.add_argument("--bus", action="append", default=[], metavar="NAME=ADDRESS", help="as in crane0=wire:crane0")
    parser.add_argument("--tick-port", type=int, required=True, help="UDP port of the controller's tick records")
    parser.add_argument("--report-port", type=int, required=True, help="UDP port of the controller's state reports")
    parser.add_argument("--profile", default="palms_471", help="shipped name or TOML file")
    parser.add_argument("--timing", type=Path, metavar="FILE", help="the controller's timing page, kept once a second")
    parser.add_argument("--seed", type=int, help="of the run, for the manifest")
    parser.add_argument("--key-file", type=Path, help="file with the key of authenticated datagrams")
    parser.add_argument(
        "--no-sync", action="store_true", help="leave it to the system when data reaches the disk (on a bench)"
    )
    a = parser.parse_args(arguments)
    addresses = dict(text.partition("=")[::2] for text in a.bus)
    try:
        profile = load_profile(a.profile)
        known = [profile.crane_bus, profile.machine_bus]
        for name in addresses:
            if name not in known:
                parser.error(f"--bus {name}: the buses of {profile.name} are {', '.join(filter(None, known))}")
        ticks, reports = udp_socket(a.tick_port), udp_socket(a.report_port)
        buses = {name: open_bus(address) for name, address in addresses.items()}
        key = a.key_file.read_bytes().strip() if a.key_file else None
        recorder = Recorder(a.out, profile, describe(profile, tuple(addresses), a.seed, live=True), key, not a.no_sync)
    except (ProfileError, RecordingRefused) as error:
        say(str(error))
        return 3
    except BusError as error:
        say(str(error))
        return 4
    except (OSError, OverflowError) as error:
        say(f"a port or file cannot be used ({error}); choose another")
        return 4
    shell = Shell(buses, ticks, reports, a.timing)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: shell.end())
    writer = threading.Thread(target=write_all, args=(recorder, shell), name="writer")
    writer.start()
    sys.stdout.write(json.dumps({"ready": True, "out": str(a.out)}) + "\n")
    sys.stdout.flush()
    shell.run()
    writer.join()
    for bus in buses.values():
        bus.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
