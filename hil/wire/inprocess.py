"""A participant on a `WireCore` in the same process: the bus of lockstep runs, on the core's own time.

The harness advances time with `WireCore.advance`; `send` queues at that time, `drain` returns the frames that have
arrived by then.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from can_dbc.bus.base import BaseBus, BusState, FilterItem
from can_dbc.frame import ERROR, Frame
from hil.wire.core import WireCore


class InProcessBus(BaseBus):
    """One participant (contract: `can_dbc.bus.base.Bus`); `participant` names it for faults and reports."""

    def __init__(
        self,
        core: WireCore,
        participant: str,
        *,
        filters: Iterable[FilterItem] | None = None,
        receive_own: bool = False,
        tx_queue: int = 10,
    ) -> None:
        super().__init__(core.name)
        self._core = core
        self.node = core.attach(participant, filters=filters, receive_own=receive_own, queue_limit=tx_queue)

    def fileno(self) -> int:
        return -1

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> int:
        stats, sent = self.stats, 0
        if stats.state is not BusState.DOWN:
            for key, data in frames:
                if not self._core.submit(self.node, key, data):
                    break
                sent += 1
        stats.sent += sent
        stats.refused += len(frames) - sent
        return sent

    def discard(self) -> int:
        before = len(self.node.queue)
        self.node.discard()
        cancelled = before - len(self.node.queue)
        self.stats.refused += cancelled
        return cancelled

    def flush(self) -> None:
        self.discard()
        self._receive([])

    def _receive(self, frames: list[Frame]) -> None:
        stats, first = self.stats, len(frames)
        for frame in self.node.take():
            if frame.key & ERROR:
                if stats.note_error(frame.key, frame.data):
                    del frames[first:]
            else:
                frames.append(frame)
        stats.dropped = self.node.dropped

    def _release(self) -> None:
        self._core.retire(self.node)
