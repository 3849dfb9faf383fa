"""What waits for a bus that transmits nothing: no command that is older than the queue's bound leaves afterwards."""

from __future__ import annotations

import msgspec
import pytest

from can_dbc.frame import Frame
from can_dbc.messages.tick_record import BusReading
from controller.bus_io import BusMonitor
from controller.config import MIN_QUEUE_FRAMES, TX_QUEUE_NS, load
from controller.process.bus_link import BusLink
from hil.wire.core import WireCore
from hil.wire.faults import Fault, Kind
from hil.wire.inprocess import InProcessBus
from machine.loading.profile_file import load_profile
from machine.profile import Plc
from machine.status.reasons import Reason

MS = 1_000_000
COMMANDS = (0x210, 0x310, 0x080)
"""The frames of a tick."""


class Rig:
    """A controller that numbers its commands, on a bus that a babbling node occupies from 100 ms on."""

    def __init__(self, rate_hz: int, end_ns: int) -> None:
        self.period_ns = 1_000_000_000 // rate_hz
        self.core = WireCore(1_000_000)
        self.core.inject(Fault(Kind.BABBLE, 100 * MS, end_ns, key=0x000))
        self.bus = InProcessBus(self.core, "controller", tx_queue=load("palms_471", rate_hz).tx_queue_frames[0])
        self.listener = InProcessBus(self.core, "listener")
        self.link, self.reading, self.monitor = BusLink(self.bus), BusReading(), BusMonitor(0)
        self.reasons: list[tuple[int, Reason]] = []

    def run(self, until_ns: int) -> list[Frame]:
        """The commands that arrived; their data is the time of their tick."""
        arrived: list[Frame] = []
        while self.core.now_ns < until_ns:
            now_ns = self.core.now_ns
            self.link.receive([], self.reading)
            self.monitor.update(self.reading, True, now_ns)
            self.reasons.append((now_ns, self.monitor.reason))
            self.link.send([(key, now_ns.to_bytes(8, "big")) for key in COMMANDS])
            self.core.advance(now_ns + self.period_ns)
            self.listener.drain(arrived)
        return [frame for frame in arrived if frame.key in COMMANDS]

    def ages_ns(self, frames: list[Frame]) -> list[int]:
        return [frame.stamp_ns - int.from_bytes(frame.data, "big") for frame in frames]


@pytest.mark.parametrize("rate_hz", [50, 200, 1000])
@pytest.mark.parametrize("blocked_ms", [15, 40, 500])
def test_no_command_leaves_that_is_older_than_the_bound(rate_hz: int, blocked_ms: int) -> None:
    rig = Rig(rate_hz, (100 + blocked_ms) * MS)
    arrived = rig.run(800 * MS)
    assert max(rig.ages_ns(arrived)) <= TX_QUEUE_NS + 2 * rig.period_ns
    last = [frame for frame in arrived if frame.stamp_ns > (130 + blocked_ms) * MS]
    assert max(rig.ages_ns(last)) <= rig.period_ns, "the queue is empty again"


@pytest.mark.parametrize("rate_hz", [200, 1000])
def test_a_short_stall_loses_nothing(rate_hz: int) -> None:
    rig = Rig(rate_hz, 115 * MS)
    ticks = 200 * MS // rig.period_ns
    assert len(rig.run(200 * MS)) == ticks * len(COMMANDS)
    assert rig.bus.stats.refused == 0


@pytest.mark.parametrize("rate_hz", [200, 1000])
def test_a_bus_that_transmits_nothing_is_reported_within_50_ms(rate_hz: int) -> None:
    """Catalogue entry 12: what was cancelled counts as refused, tick after tick."""
    rig = Rig(rate_hz, 500 * MS)
    rig.run(400 * MS)
    seen_ns = next(at_ns for at_ns, reason in rig.reasons if reason is Reason.SEND_REFUSED)
    assert seen_ns - 100 * MS <= 50 * MS
    assert rig.reasons[-1][1] is Reason.SEND_REFUSED, "and as long as it lasts"


def test_commands_that_are_not_due_in_every_tick_are_neither_cancelled_early_nor_sent_late() -> None:
    """As on mach0: four frames in every fourth tick, and a queue for two periods."""
    core = WireCore(250_000)
    core.inject(Fault(Kind.BABBLE, 100 * MS, 400 * MS, key=0x000))
    bus, listener = InProcessBus(core, "controller", tx_queue=MIN_QUEUE_FRAMES), InProcessBus(core, "listener")
    link, reading, monitor = BusLink(bus), BusReading(), BusMonitor(1)
    arrived: list[Frame] = []
    seen_ns, sent = None, False
    for tick in range(120):
        link.receive([], reading)
        monitor.update(reading, sent, core.now_ns)
        if seen_ns is None and monitor.reason is Reason.SEND_REFUSED:
            seen_ns = core.now_ns
        sent = tick % 4 == 0
        link.send([(0x300 + i, core.now_ns.to_bytes(8, "big")) for i in range(4)] if sent else [])
        core.advance(core.now_ns + 5 * MS)
        listener.drain(arrived)
    ages_ns = [frame.stamp_ns - int.from_bytes(frame.data, "big") for frame in arrived if frame.key >= 0x300]
    assert max(ages_ns) <= 45 * MS and len([age for age in ages_ns if age < 5 * MS]) >= 4 * 14
    assert seen_ns is not None and seen_ns - 100 * MS <= 100 * MS


def test_joint_references_have_room_in_the_queue() -> None:
    settings = load("palms_471")
    plain = settings.tx_queue_frames[0]
    profile = msgspec.structs.replace(load_profile("palms_471"), plc=Plc("references"))
    assert type(settings)(profile, 0, settings.rate_hz).tx_queue_frames[0] > plain
