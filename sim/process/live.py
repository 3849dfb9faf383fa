"""An emulated machine in real time on real buses: shared by ``python -m sim`` and the timing test bed.

Deadlines are absolute.  The machine wakes when its next step is due or a frame arrives, so a SYNC is answered at once.
When the host is too slow for real time, the machine's time pauses for a moment (no burst); the pauses are counted.
"""

from __future__ import annotations

import select
import time
from collections.abc import Mapping

from can_dbc.bus.base import Bus, BusState
from can_dbc.bus.reconnector import Reconnector
from can_dbc.frame import Frame
from sim.emulation import EmulatedMachine

TX_QUEUE_FRAMES = 256  # this process emulates a dozen nodes
MAX_LAG_NS = 25_000_000


class LiveMachine:
    """A machine and its buses, by name.  ``stop`` ends ``run``."""

    def __init__(self, machine: EmulatedMachine, buses: Mapping[str, Bus]) -> None:
        self._machine, self._buses = machine, dict(buses)
        self._running = True
        self._skipped_ns = self._started_ns = self._stalls = 0
        self._links = [Reconnector(bus) for bus in self._buses.values()]

    def stop(self, *_: object) -> None:
        """End after the present step; usable as a signal handler."""
        self._running = False

    def run(self) -> None:
        """Run until stopped."""
        machine, frames = self._machine, list[Frame]()
        self._started_ns = time.monotonic_ns()
        while self._running:
            now_ns = time.monotonic_ns() - self._skipped_ns
            behind_ns = now_ns - machine.next_ns if machine.next_ns else 0
            if behind_ns > MAX_LAG_NS:
                self._skipped_ns += behind_ns
                self._stalls += 1
                now_ns -= behind_ns
            received = []
            for name, bus in self._buses.items():
                frames.clear()
                bus.drain(frames)
                self._on_received(frames)
                received += [(name, f._replace(stamp_ns=f.stamp_ns - self._skipped_ns)) for f in frames]
            sent: dict[str, list[tuple[int, bytes]]] = {}
            for name, key, data in machine.step(now_ns, received):
                sent.setdefault(name, []).append((key, data))
            for name, out in sent.items():
                self._buses[name].send_all(out)
            for link in self._links:
                link.watch(now_ns)
            self._on_step(now_ns)
            pause_ns = machine.next_ns - (time.monotonic_ns() - self._skipped_ns)
            if pause_ns > 0:
                self._wait(pause_ns * 1e-9)

    def _on_received(self, frames: list[Frame]) -> None:
        """Act on the frames drained from a bus; called with them."""

    def _on_step(self, now_ns: int) -> None:
        """Act after a step; called after every step."""

    def _wait(self, pause_s: float) -> None:
        """Wait until the next step is due or a frame arrives.

        A bus that is down would always be readable, so it is left out.
        """
        listening = [b for b in self._buses.values() if b.fileno() >= 0 and b.stats.state is not BusState.DOWN]
        if listening:
            select.select(listening, (), (), pause_s)
        else:
            time.sleep(pause_s)

    def report(self) -> dict[str, float]:
        """Report real-time statistics in totals: share of time lost, number of pauses, frames of the buses."""
        elapsed_ns = max(1, time.monotonic_ns() - self._started_ns)
        stats = [bus.stats for bus in self._buses.values()]
        return {
            "time_s": elapsed_ns * 1e-9,
            "lost_share": self._skipped_ns / elapsed_ns,
            "stalls": self._stalls,
            "sent_frames": sum(s.sent for s in stats),
            "received_frames": sum(s.received for s in stats),
            "refused_frames": sum(s.refused for s in stats),
            "dropped_frames": sum(s.dropped for s in stats),
        }
