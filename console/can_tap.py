"""Listens to the buses for the CAN table, read-only, and only while a page shows it.

The buses are opened as the recorder opens them, with no filter; nothing is ever sent.  The controller does nothing for
it: a frame is delivered to one more listener.  Nobody looks: the buses are closed, and the table is forgotten.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any, Final

from can_dbc.bus.base import BITRATES, Bus
from can_dbc.bus.factory import open_bus
from can_dbc.bus.reconnector import Reconnector
from can_dbc.dbc.codec import Database, load
from can_dbc.frame import Frame
from console.can_table import CanTable
from machine.profile import Profile
from runtime.errors import LinkError

PERIOD_S: Final = 0.05
RETRY_NS: Final = 1_000_000_000
IDENTITY: Final = "console"


def load_databases(profile: Profile) -> dict[str, tuple[Database, ...]]:
    """Load the databases by the bus; reading takes so long that it is done before anything is served."""
    names = {profile.crane_bus: ("crane",), profile.machine_bus: ("machine", "gnss")}
    return {bus: tuple(map(load, databases)) for bus, databases in names.items() if bus}


class CanTap:
    """``addresses`` by the buses' names; ``clock`` is that of the frames' stamps."""

    def __init__(self, profile: Profile, addresses: Mapping[str, str], clock: Callable[[], int]) -> None:
        self._addresses, self._clock = dict(addresses), clock
        self._databases = load_databases(profile) if addresses else {}
        self._open: dict[str, tuple[Bus, Reconnector, CanTable]] = {}
        self._refusal: dict[str, str] = {}
        self._retry_ns: dict[str, int] = {}
        self._viewers = self._drained_ns = 0
        self._told: list[dict[str, Any]] = []
        self._task: asyncio.Task[None] | None = None

    @property
    def buses(self) -> list[str]:
        """The buses that can be shown."""
        return list(self._addresses)

    @contextlib.asynccontextmanager
    async def viewer(self) -> AsyncIterator[None]:
        """Count one viewer more while the context lasts; listen to the buses while there is any."""
        self._viewers += 1
        if self._task is None:
            self._task = asyncio.create_task(self._listen())
        try:
            yield
        finally:
            self._viewers -= 1
            if not self._viewers:
                self._task.cancel()
                self._task = None
                self._close()

    def tables(self) -> list[dict[str, Any]]:
        """Return the tables now, the same for every page; of a bus that cannot be opened the sentence why."""
        if self._told:
            return self._told
        self._drain()
        bus_tables: list[dict[str, Any]] = []
        for name in self._addresses:
            if name in self._open:
                bus, _, table = self._open[name]
                stats = bus.stats
                bus_tables.append(table.table(self._drained_ns) | {"state": stats.state.name, "dropped": stats.dropped})
            else:
                bus_tables.append({"bus": name, "refusal": self._refusal.get(name, "opening")})
        self._told = bus_tables
        return bus_tables

    async def _listen(self) -> None:
        while True:
            for name, address in self._addresses.items():
                if name not in self._open:
                    await self._try(name, address)
            self._drain()
            self._told = []
            await asyncio.sleep(PERIOD_S)

    def _drain(self) -> None:
        self._drained_ns = self._clock()  # ages are those of this moment: later frames wait in the sockets
        for bus, link, table in self._open.values():
            frames: list[Frame] = []
            bus.drain(frames)
            table.on_frames(frames)
            link.watch(self._drained_ns)

    async def _try(self, name: str, address: str) -> None:
        now_ns = self._clock()
        if now_ns < self._retry_ns.get(name, 0):
            return
        self._retry_ns[name] = now_ns + RETRY_NS
        opening = asyncio.ensure_future(asyncio.to_thread(open_bus, address, participant=IDENTITY))
        try:
            bus = await asyncio.shield(opening)
        except LinkError as error:
            self._refusal[name] = str(error)
            return
        except asyncio.CancelledError:  # the last page has gone meanwhile
            opening.add_done_callback(_close_opened)
            raise
        bitrate = getattr(bus, "bitrate", 0) or BITRATES.get(name, 0)
        self._open[name] = bus, Reconnector(bus), CanTable(name, self._databases.get(name, ()), bitrate)

    def _close(self) -> None:
        for bus, _, _ in self._open.values():
            bus.close()
        self._open.clear()
        self._told = []


def _close_opened(opening: asyncio.Future[Bus]) -> None:
    if not opening.cancelled() and opening.exception() is None:
        opening.result().close()
