"""The bridge's real UDP link against the emulated PLC on real sockets: sessions, keys, a second bridge."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from can_dbc.dbc.codec import load
from can_dbc.plc.map import State
from controller.plc.__main__ import UdpLink
from controller.plc.bridge import Bridge
from controller.plc.handshake import Handshake
from hil.plc import write_plc_profile
from machine.loading.profile_file import load_profile
from tests.live.sim.plc_server import LOOPBACK, ServedPlc

KEY = b"a key of sixteen"
LIMIT_S = 20.0


class Linked:
    """A bridge with its link; `until` runs both."""

    def __init__(self, plc: ServedPlc, directory: Path, key: bytes | None = None, first: int = 1000) -> None:
        profile = load_profile(str(write_plc_profile("palms_471", "valves", directory)))
        self.bridge = Bridge(profile, load("crane"), Handshake(key=key, first_sequence=first))
        self.shake, self._plc = self.bridge.handshake, plc

    async def run(self, until, limit_s: float = LIMIT_S) -> bool:
        """Whether the condition came true in time."""
        link = UdpLink(self.bridge, LOOPBACK, self._plc.udp_port)
        exchanging = asyncio.create_task(link.run())
        try:
            for _ in range(round(limit_s / 0.01)):
                await asyncio.sleep(0.01)
                if until():
                    return True
            return bool(until())
        finally:
            exchanging.cancel()
            link.close()


@pytest.mark.parametrize("key", [None, KEY])
def test_a_bridge_gets_a_session_and_exchanges(key: bytes | None, tmp_path: Path) -> None:
    with ServedPlc(key=key) as plc:
        linked = Linked(plc, tmp_path, key)
        assert asyncio.run(linked.run(lambda: linked.shake.answers > 30))
        assert linked.shake.feedback is not None and linked.shake.feedback.state is State.HOLD
        assert plc.program.arbiter.session.number != 0 and plc.program.arbiter.accepted > 10
        assert (linked.shake.dropped, plc.program.arbiter.dropped) == (0, 0)


def test_without_the_key_a_bridge_gets_no_answer(tmp_path: Path) -> None:
    with ServedPlc(key=KEY) as plc:
        linked = Linked(plc, tmp_path, b"another key of 16")
        assert not asyncio.run(linked.run(lambda: linked.shake.answers > 0, 0.5))
        assert plc.program.arbiter.dropped > 0 and plc.program.arbiter.accepted == 0


def test_a_bridge_that_starts_again_waits_for_the_plc_to_end_the_old_session(tmp_path: Path) -> None:
    """It has another port, so the PLC's watchdog of 300 ms must expire first; then SAFE is latched."""
    with ServedPlc() as plc:
        first = Linked(plc, tmp_path)
        assert asyncio.run(first.run(lambda: first.shake.answers > 30))
        session = plc.program.arbiter.session.number
        again = Linked(plc, tmp_path, first=5000)
        assert asyncio.run(again.run(lambda: again.shake.answers > 30))
        assert plc.program.arbiter.session.number not in (0, session)
        assert plc.program.state is State.SAFE
