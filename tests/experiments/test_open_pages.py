"""Open pages of the console change no tick: it never waits for them, and does the same beside ten as beside none."""

from __future__ import annotations

import socket
from pathlib import Path

from can_dbc.messages.crane import StateReport
from can_dbc.messages.datagrams import decode
from can_dbc.messages.record_ring import RecordRing
from controller.process.loop import Loop
from controller.process.timing import LoopTiming
from controller.process.warm_up import NullBus
from controller.step import Controller
from experiments.timing.open_pages import Window, judge
from tests.controller.bench import DATABASE, SETTINGS, T
from tests.operator_end import udp_end

TICKS = 3000
SECOND_NS = 10**9


class KeptBus(NullBus):
    """Keeps what is sent."""

    def __init__(self) -> None:
        super().__init__("kept")
        self.sent: list[tuple[int, bytes]] = []

    def send_all(self, frames: list[tuple[int, bytes]]) -> int:
        self.sent += frames
        return len(frames)


def ticks_of(folder: Path, reads: bool) -> tuple[KeptBus, Loop, list[bytes], int]:
    """Ticks of a loop whose console reads every report, or none; the reports, and how many the kernel let go."""
    folder.mkdir()
    bus, controller, got, now = KeptBus(), Controller(SETTINGS, DATABASE), list[bytes](), SECOND_NS
    with udp_end() as setpoints, udp_end() as console:
        console.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        timing = LoopTiming(controller, None, lambda: now, lambda: now)
        loop = Loop(
            controller,
            [bus],
            setpoints,
            None,
            [console.getsockname()],
            RecordRing(folder / "ticks"),
            timing,
            T,
            SETTINGS.sync_lead_ns,
            lambda: now,
            lambda _: None,
        )
        assert not any(receiver.getblocking() for receiver in loop._reports), "a full socket cannot hold a tick"
        for k in range(TICKS):
            now = SECOND_NS + k * T
            loop.tick(now, 0)
            while reads:
                try:
                    got.append(console.recv(2048))
                except BlockingIOError:
                    break
        lost = dropped(console.getsockname()[1])
        loop.close()
    return bus, loop, got, lost


def dropped(port: int) -> int:
    """Datagrams that the kernel has dropped at a port (proc(5), net/udp)."""
    rows = [line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
    return next(int(row[-1]) for row in rows if int(row[1].split(":")[1], 16) == port)


def test_a_console_that_reads_nothing_changes_no_command_and_loses_only_reports(tmp_path: Path) -> None:
    reading, first, got, none_lost = ticks_of(tmp_path / "reading", reads=True)
    silent, second, _, lost = ticks_of(tmp_path / "silent", reads=False)
    reports = [decode(data) for data in got]
    assert len(reports) == TICKS // 4 and all(isinstance(report, StateReport) for report in reports), "50 Hz"
    assert none_lost == 0 < lost < len(reports), "the kernel drops and counts what the console does not take"
    assert silent.sent == reading.sent and len(silent.sent) > TICKS
    assert (first.ticks, second.ticks) == (TICKS, TICKS) and first.missed == second.missed == 0


def window(cpu_us: float = 400.0, calls: float | None = 9.5) -> Window:
    return Window(800, 0, cpu_us, 3.3, None, calls, 100)


def test_counts_that_differ_and_a_tick_that_costs_more_are_told() -> None:
    none = [window() for _ in range(7)]
    assert judge({"none": none, "open": [window(410.0) for _ in none]})["reached"]
    more = judge({"none": none, "open": [window(calls=10.5) for _ in none]})
    assert not more["reached"] and more["counts"]["calls"] == {"none": 9.5, "open": 10.5, "same": False}
    dear = judge({"none": none, "open": [window(800.0) for _ in none]})
    assert not dear["reached"] and dear["cpu"]["verdict"] == "missed" and dear["counts"]["calls"]["same"]


def test_a_loud_host_decides_no_time_and_still_counts() -> None:
    loud = [window(cpu_us) for cpu_us in (300.0, 900.0, 350.0, 800.0, 420.0, 600.0, 500.0)]
    found = judge({"none": loud, "open": list(reversed(loud))})
    assert found["cpu"]["verdict"] == "inconclusive" and found["reached"]
    untraced = judge({"none": [window(calls=None)], "open": [window(calls=None)]})
    assert untraced["counts"]["calls"]["same"] is None and untraced["reached"]
