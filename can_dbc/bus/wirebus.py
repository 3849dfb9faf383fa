"""The wire as a python-can interface: ``python -m can.viewer -i timberhand -c crane0``.

Registered in the entry point group ``can.interface`` as ``timberhand``, so that viewer, logger, player and every other
python-can program can join a wire bus.  Stamps are wall-clock seconds, as python-can expects.  One thread may receive
while another one sends.
"""

from __future__ import annotations

import select
import threading
import time
from collections import deque
from typing import Any

import can

from can_dbc.bus.base import BusState
from can_dbc.bus.python_can_bus import key_of, message_of, payload_of
from can_dbc.bus.wire_client import WireClient
from can_dbc.frame import Frame
from runtime.errors import LinkError

_STATES = {
    BusState.PASSIVE: can.BusState.PASSIVE,
    BusState.OFF: can.BusState.ERROR,
    BusState.DOWN: can.BusState.ERROR,
}


class WireBus(can.BusABC):
    """One participant on a wire bus; `channel` is its name, `tx_queue` as in `can_dbc.bus.factory.open_bus`."""

    def __init__(
        self,
        channel: str,
        can_filters: Any = None,
        receive_own_messages: bool = False,
        tx_queue: int = 10,
        **_: object,
    ) -> None:
        """Ignore other python-can options (bitrate, fd, ...), which belong to the daemon.

        Raises:
            can.CanInitializationError: The bus cannot be opened.
        """
        try:
            self._client = WireClient(channel, None, receive_own_messages, tx_queue, error_frames=True)
        except LinkError as error:
            raise can.CanInitializationError(str(error)) from error
        self.channel_info = f"timberhand wire {channel} at {self._client.bitrate} bit/s"
        self._waiting: deque[Frame] = deque()
        self._lock = threading.Lock()  # both directions share the client's counters and buffer
        super().__init__(channel, can_filters)

    def fileno(self) -> int:
        return self._client.fileno()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Wait for room in the transmit queue up to `timeout` seconds (None: for ever, 0: not at all), and send.

        Raises:
            can.CanOperationError: There is no room, the bus is off or down, or the message is not classical CAN.
        """
        if msg.is_error_frame or msg.is_fd:
            raise can.CanOperationError(f"{self.channel_info}: error frames and CAN FD cannot be sent.")
        deadline_s = None if timeout is None else time.monotonic() + timeout
        while True:
            with self._lock:
                if self._client.send(key_of(msg), payload_of(msg)):
                    return
                state = self._client.stats.state
            if state >= BusState.OFF:
                raise can.CanOperationError(f"{self.channel_info}: the bus is {state.name.lower()}.")
            if deadline_s is not None and time.monotonic() >= deadline_s:
                raise can.CanOperationError(f"{self.channel_info}: the transmit queue is full.")
            time.sleep(0.0005)  # a few frame times: the receiving thread may read the counters from the socket

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._waiting:
            with self._lock:
                self._fetch()
            if not self._waiting and self._client.stats.state is BusState.DOWN:
                raise can.CanOperationError(f"{self.channel_info}: the wire daemon has ended.")
            if not self._waiting and select.select([self._client], [], [], timeout)[0]:
                with self._lock:
                    self._fetch()
        if not self._waiting:
            return None, False
        stamp_ns, key, data = self._waiting.popleft()
        wall_s = time.time() - (time.monotonic_ns() - stamp_ns) * 1e-9
        message = message_of(key, data, wall_s)
        message.channel = self._client.name
        return message, False

    def _fetch(self) -> None:
        frames: list[Frame] = []
        self._client.drain(frames)
        self._waiting.extend(frames)

    def flush_tx_buffer(self) -> None:
        """Cancel the own frames whose transmission has not begun."""
        with self._lock:
            self._client.discard()

    @property
    def state(self) -> can.BusState:
        return _STATES.get(self._client.stats.state, can.BusState.ACTIVE)

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        raise NotImplementedError("The state follows the error counters of the wire; it cannot be set.")

    def shutdown(self) -> None:
        super().shutdown()
        self._client.close()
