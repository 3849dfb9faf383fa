"""``python -m recorder``: records buses, tick records, state reports and timing until SIGTERM or SIGINT.

The receiving thread only receives and queues, the writing thread only writes: a disk that blocks for seconds costs
nothing, and one that blocks longer costs records, which are counted and reported on stderr at most once per second.
When everything is open, one JSON line with ``ready`` goes to stdout.

Exit codes: 0 normal end, 1 the writing thread failed, 2 usage, 3 the directory, profile or key cannot be used,
4 a bus or port cannot be used.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import queue
import select
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from can_dbc.bus.base import Bus, BusState
from can_dbc.bus.batch import enlarge_receive_buffer
from can_dbc.bus.factory import open_bus
from can_dbc.bus.reconnector import Reconnector
from can_dbc.frame import Frame
from can_dbc.messages.envelope import SERVICE_KEY, read_key, service_key
from can_dbc.messages.picture import decode_picture, encode_picture_request
from can_dbc.messages.record_ring import RingReader, default_path
from can_dbc.messages.udp_address import address_argument
from can_dbc.timing.page import Timing, read_timing
from machine.loading.profile_file import ProfileError, load_profile
from machine.status.explanation import ERROR, message_id, priority
from machine.status.reasons import known
from recorder.manifest import describe
from recorder.recorder import Recorder
from recorder.stop_recorder import Stop
from runtime.errors import ConfigError, InputRefused, LinkError

# -- Entries for systemd's journal with fields of their own, in its native protocol and without a library.
#
# One datagram to a Unix socket: ``NAME=value`` lines; a value with a line feed is written as its name, a line feed,
# its length as u64 little-endian, and the bytes (systemd, "Native Journal Protocol").  The bindings python-systemd
# and cysystemd need libsystemd and a compiler to be installed, for the twenty lines below.

SOCKET: Final = Path("/run/systemd/journal/socket")
_LENGTH: Final = struct.Struct("<Q")


def encode(fields: Mapping[str, str]) -> bytes:
    """Encode the datagram of an entry."""
    data = bytearray()
    for name, value in fields.items():
        text = value.encode()
        if b"\n" in text:
            data += name.encode() + b"\n" + _LENGTH.pack(len(text)) + text + b"\n"
        else:
            data += name.encode() + b"=" + text + b"\n"
    return bytes(data)


def send(fields: Mapping[str, str], path: Path = SOCKET) -> bool:
    """Write an entry without waiting; False where no journal takes it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)
        try:
            sender.sendto(encode(fields), str(path))
        except OSError:
            return False
    return True


def stop_fields(stop: Stop, file: Path) -> dict[str, str]:
    """Return the fields of a stop's entry; ``MESSAGE_ID`` finds the text of `journalctl -x` in timberhand.catalog."""
    fields = {
        "MESSAGE": f"{stop.mode}: {stop.text}",
        "PRIORITY": str(ERROR),
        "SYSLOG_IDENTIFIER": "timberhand",
        "TIMBERHAND_CODE": stop.code,
        "TIMBERHAND_MODE": stop.mode,
        "TIMBERHAND_MODE_BEFORE": stop.mode_before,
        "TIMBERHAND_FILE": str(file),
    }
    reason = known(stop.reason)
    if reason is None:
        return fields
    return fields | {
        "MESSAGE_ID": message_id(reason),
        "PRIORITY": str(priority(reason)),
        "TIMBERHAND_PART": stop.explanation.part or "the machine",
        "TIMBERHAND_MEASURED": stop.explanation.measured or "nothing",
    }


QUEUE_ITEMS: Final = 50_000
"""About ten seconds of two busy buses."""
FLUSH_PERIOD_S: Final = 0.1
POLL_PERIOD_S: Final = 0.02
MAX_DATAGRAM_BYTES: Final = 65536
TIMING_PERIOD_S: Final = 1.0
PICTURE_PERIOD_S: Final = 1.0

Item = tuple[str, str, list[Frame] | bytes | Timing]


class InputCollector:
    """The receiving side: queues everything that arrives, and counts what does not fit.

    It polls every 20 ms instead of waking for every frame: the bus stamps the frames, the sockets hold far more, and a
    sleeping recorder leaves the processor to real-time processes.
    """

    def __init__(
        self,
        buses: dict[str, Bus],
        ticks: RingReader,
        reports: socket.socket,
        timing: Path | None = None,
        detector: tuple[str, int] | None = None,
    ) -> None:
        self.items: queue.Queue[Item | None] = queue.Queue(QUEUE_ITEMS)
        self.dropped = 0
        self.failed = False
        """The writing thread ended by an error."""
        self._buses = tuple(buses.values())
        self.wake, self._ask = socket.socketpair()
        self._receivers = [self._frames_of(name, bus) for name, bus in buses.items()]
        self._ticks = ticks
        self._receivers += [self._tick_records, self._datagrams("report", reports)]
        self._receivers += [self._timing_page(timing)] if timing else []
        self._receivers += [self._pictures(detector)] if detector else []

    def run(self) -> None:
        """Receive until ``end``, then what still waits."""
        ended = False
        try:
            while not ended:
                ended = bool(select.select([self.wake], [], [], POLL_PERIOD_S)[0])
                for receive in self._receivers:
                    receive()
        finally:
            self._end_items()

    def _end_items(self) -> None:
        """Queue the None that ends the writing thread, which may be behind, or have failed."""
        while not self.failed:
            with contextlib.suppress(queue.Full):
                return self.items.put(None, timeout=POLL_PERIOD_S)

    def end(self) -> None:
        """Make ``run`` return; may be called from a signal handler."""
        self._ask.send(b"x")

    @property
    def lost(self) -> int:
        """Frames and records lost because the kernel's buffer, the ring or the queue was full."""
        return self.dropped + self._ticks.lost + sum(bus.stats.dropped for bus in self._buses)

    def _put(self, item: Item, count: int) -> None:
        try:
            self.items.put_nowait(item)
        except queue.Full:
            self.dropped += count

    def _frames_of(self, name: str, bus: Bus) -> Callable[[], None]:
        link, was_down = Reconnector(bus), False
        lost, report_after_s = 0, 0.0

        def receive() -> None:
            nonlocal was_down, lost, report_after_s
            frames: list[Frame] = []
            if bus.drain(frames):
                self._put(("frames", name, frames), len(frames))
            down = bus.stats.state is BusState.DOWN
            if down != was_down:
                was_down = down
                report(f"{name} is {'down; recording continues when it is back' if down else 'back'}")
            if bus.stats.dropped > lost and (now := time.monotonic()) >= report_after_s:
                lost, report_after_s = bus.stats.dropped, now + 1.0
                report(f"{lost} frames of {name} arrived too fast to record; give the recorder more processor time")
            link.watch(time.monotonic_ns())

        return receive

    def _timing_page(self, path: Path) -> Callable[[], None]:
        next_read_s, written_ns = 0.0, 0

        def receive() -> None:
            nonlocal next_read_s, written_ns
            if (now := time.monotonic()) < next_read_s:
                return
            next_read_s = now + TIMING_PERIOD_S
            with contextlib.suppress(InputRefused):  # no controller, or one that has not started
                timing = read_timing(path)
                if timing.facts.written_ns != written_ns:
                    written_ns = timing.facts.written_ns
                    self._put(("timing", "", timing), 1)

        return receive

    def _pictures(self, detector: tuple[str, int]) -> Callable[[], None]:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.setblocking(False)
        sock.connect(detector)
        next_ask_s, newest_ns = 0.0, 0

        def receive() -> None:
            nonlocal next_ask_s, newest_ns
            with contextlib.suppress(OSError, InputRefused):  # no detector yet, or one without a camera
                while True:
                    data = sock.recv(MAX_DATAGRAM_BYTES)
                    facts, jpeg = decode_picture(data)
                    if jpeg and facts.measured_ns > newest_ns:
                        newest_ns = facts.measured_ns
                        self._put(("picture", "", data), 1)
            if (now := time.monotonic()) >= next_ask_s:
                next_ask_s = now + PICTURE_PERIOD_S
                with contextlib.suppress(OSError):
                    sock.send(encode_picture_request(newest_ns))

        return receive

    def _tick_records(self) -> None:
        for record in self._ticks.read():
            self._put(("tick", "", record), 1)

    def _datagrams(self, kind: str, sock: socket.socket) -> Callable[[], None]:
        def receive() -> None:
            try:
                while True:
                    self._put((kind, "", sock.recv(MAX_DATAGRAM_BYTES)), 1)
            except BlockingIOError:
                pass

        return receive


def write_all(recorder: Recorder, inputs: InputCollector) -> None:
    """Pass everything in the queue to the recorder, until None: the writing thread; its failure ends the inputs."""
    try:
        _write_all(recorder, inputs)
    except BaseException:
        inputs.failed = True
        inputs.end()
        raise


def _write_all(recorder: Recorder, inputs: InputCollector) -> None:
    reported, report_after_s, key_reported = 0, 0.0, False
    flush_at = time.monotonic() + FLUSH_PERIOD_S
    while True:
        try:
            item = inputs.items.get(timeout=max(0.0, flush_at - time.monotonic()))
        except queue.Empty:
            item = ("", "", b"")
        if item is None:
            break
        kind, name, payload = item
        if isinstance(payload, list):
            for frame in payload:
                recorder.on_frame(name, frame)
        elif isinstance(payload, Timing):
            recorder.on_timing(payload)
        elif kind == "tick":
            recorder.on_tick(payload)
        elif kind == "report":
            recorder.on_report(payload)
            if recorder.other_key and not key_reported:
                key_reported = True
                report("state reports are refused: give the controller's key with --key-file")
        elif kind == "picture":
            recorder.on_picture(payload)
        now = time.monotonic()
        if now >= flush_at:
            recorder.flush(time.monotonic_ns())
            flush_at = time.monotonic() + FLUSH_PERIOD_S
        lost = recorder.lost + inputs.dropped
        if lost > reported and now >= report_after_s:
            report(f"{lost} records could not be written so far; free space on the disk")
            reported, report_after_s = lost, now + 1.0
    recorder.dropped += inputs.lost
    recorder.close()


def report(sentence: str) -> None:
    """Write one line to stderr, where that is possible: it may be a file on the same full disk."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        sys.stderr.write(f"recorder: {sentence}\n")


def write_to_journal(stop: Stop, file: Path) -> None:
    """Write a stop to the journal, or to stderr where there is none."""
    fields = stop_fields(stop, file)
    if not send(fields):
        report(f"{fields['MESSAGE']} {file}")


def udp_socket(port: int) -> socket.socket:
    """Open a non-blocking socket bound on loopback; raises OSError."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setblocking(False)
    enlarge_receive_buffer(sock, 4 << 20)
    sock.bind(("127.0.0.1", port))
    return sock


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the process; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m recorder", description="Records buses, ticks and reports.")
    parser.add_argument("--out", type=Path, required=True, help="directory of the recording, without one so far")
    parser.add_argument(
        "--bus",
        action="append",
        default=[],
        metavar="NAME=ADDRESS",
        help="bus to record, for example crane0=wire:crane0",
    )
    parser.add_argument(
        "--ticks", type=Path, metavar="FILE", help="ring of the controller's tick records; default: in shared memory"
    )
    parser.add_argument("--report-port", type=int, required=True, help="UDP port of the controller's state reports")
    parser.add_argument("--profile", default="palms_471", help="shipped name or TOML file")
    parser.add_argument(
        "--timing", type=Path, metavar="FILE", help="the controller's timing page, recorded once per second"
    )
    parser.add_argument(
        "--pictures",
        type=address_argument,
        metavar="HOST:PORT",
        help="log detector whose pictures are recorded, at most one a second",
    )
    parser.add_argument("--seed", type=int, help="seed of the run, for the manifest")
    parser.add_argument("--key-file", type=Path, help=f"file with the controller's key; default: {SERVICE_KEY}, if any")
    parser.add_argument("--stops", type=Path, metavar="DIR", help="directory of the stops' files; default: OUT/stops")
    parser.add_argument("--journal", action="store_true", help="write every stop to the journal of systemd")
    parser.add_argument("--no-sync", action="store_true", help="do not flush data to the disk (for benches)")
    a = parser.parse_args(arguments)
    addresses = dict(text.partition("=")[::2] for text in a.bus)
    try:
        profile = load_profile(a.profile)
        known = [profile.crane_bus, profile.machine_bus]
        for name in addresses:
            if name not in known:
                parser.error(f"--bus {name}: the buses of {profile.name} are {', '.join(filter(None, known))}")
        ticks, reports = RingReader(a.ticks or default_path()), udp_socket(a.report_port)
        buses = {name: open_bus(address) for name, address in addresses.items()}
        key = service_key() if a.key_file is None else read_key(a.key_file)
        manifest = describe(profile, tuple(addresses), a.seed, live=True)
        on_stop = write_to_journal if a.journal else None
        recorder = Recorder(a.out, profile, manifest, key, not a.no_sync, a.stops, on_stop)
    except (ProfileError, InputRefused, ConfigError) as error:
        report(str(error))
        return 3
    except LinkError as error:
        report(str(error))
        return 4
    except (OSError, OverflowError) as error:
        report(f"a port or file cannot be used ({error}); choose another")
        return 4
    inputs = InputCollector(buses, ticks, reports, a.timing, a.pictures)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: inputs.end())
    writer = threading.Thread(target=write_all, args=(recorder, inputs), name="writer")
    writer.start()
    with contextlib.suppress(OSError, ValueError, AttributeError):  # nobody may read it, and it records all the same
        sys.stdout.write(json.dumps({"ready": True, "out": str(a.out)}) + "\n")
        sys.stdout.flush()
    inputs.run()
    writer.join()
    ticks.close()
    for bus in buses.values():
        bus.close()
    return 1 if inputs.failed else 0


if __name__ == "__main__":
    sys.exit(main())
