"""A participant on a `WireCore` in the same process: the bus of lockstep runs, on the core's own time.

The harness moves time with `WireCore.advance`; `send` queues at that time, `drain` gives what has arrived
by it.
"""

from __future__ import annotations

from collections.abc import Iterable

from can_dbc.bus import BaseBus, BusState
from can_dbc.frame import ERROR, Frame
from hil.wire.core import WireCore


class InProcessBus(BaseBus):
    """One participant (contract: `can_dbc.bus.Bus`); `participant` names it for faults and reports."""

    def __init__(
        self,
        core: WireCore,
        participant: str,
        *,
        filters: Iterable[int] | None = None,
        receive_own: bool = False,
        tx_queue: int = 10,
    ) -> None:
        super().__init__(core.name)
        self._core = core
        self.node = core.attach(participant, keys=filters, receive_own=receive_own, queue_limit=tx_queue)

    def fileno(self) -> int:
        return -1

    def drain(self, frames: list[Frame]) -> int:
        stats, before = self.stats, len(frames)
        for frame in self.node.take():
            if frame.key & ERROR:
                stats.note_error(frame.key, frame.data)
            else:
                frames.append(frame)
        taken = len(frames) - before
        stats.received += taken
        stats.dropped = self.node.dropped
        return taken

    def send(self, key: int, data: bytes) -> bool:
        if self.stats.state is not BusState.DOWN and self._core.submit(self.node, key, data):
            self.stats.sent += 1
            return True
        self.stats.refused += 1
        return False

    def close(self) -> None:
        if self.stats.state is not BusState.DOWN:
            self.stats.state = BusState.DOWN
            self._core.retire(self.node)
