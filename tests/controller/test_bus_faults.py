"""Faults of mach0 and of both buses: reaction, time to neutral, and recovery."""

import pytest

from can_dbc.messages.crane import OperatorAction
from can_dbc.protocols.canopen import heartbeat_frame
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reaction, Reason
from tests.controller.bench import AORO, CODECS, MACHINE, MS, SETTINGS, Bench, T

PROMISE_NS = 100 * MS
S = 1_000_000_000


LOSSES = [
    ("VehStat", Reason.CARRIER_LOST),
    ("ArmHeightA", Reason.SWING_ARMS_LOST),
    ("ArmHeightB", Reason.SWING_ARMS_LOST),
]


@pytest.mark.parametrize(("name", "reason"), LOSSES)
@pytest.mark.parametrize("how", ["dropped", "corrupt", "frozen"])
def test_loss_of_carrier_or_arms_is_neutral_in_time(name, reason, how):
    bench = Bench(AORO).active()
    while name not in [MACHINE.find(f.key).name for f in bench.inputs.machine_frames if MACHINE.find(f.key)]:
        bench.drive(0, 0.08, 1)
    getattr(bench, how).add(name)
    ticks = bench.until(reason)
    assert ticks * T <= FAULTS[reason].bound_ms * MS
    assert bench.mode is Mode.FAULT and bench.neutral and bench.commands_b["ArmKey"] == 0
    assert ticks * T <= PROMISE_NS
    getattr(bench, how).clear()
    assert bench.run(100) is Mode.FAULT, "a fault stays until a human resets it"


def test_arming_needs_the_carrier():
    bench = Bench(AORO)
    bench.dropped.add("ArmHeightA")
    assert bench.run(200) is Mode.STANDBY and bench.reason == Reason.INPUT_MISSING
    assert bench.controller.stale_mask == 1 << 15
    assert bench.press(OperatorAction.ARM) is Mode.STANDBY and bench.controller.gate.refusal is Reason.INPUT_MISSING


@pytest.mark.parametrize(
    ("name", "reason"),
    [("PositionRapidUpdate", Reason.GNSS_LOST), ("VesselHeading", Reason.GNSS_LOST), ("EEC1", Reason.ENGINE_LOST)],
)
def test_loss_of_position_or_engine_is_only_reported(name, reason):
    bench = Bench(AORO).active()
    bench.dropped.add(name)
    assert bench.until(reason, 140) * T <= FAULTS[reason].bound_ms * MS + 100 * MS  # one period before it
    assert bench.mode is Mode.ACTIVE and FAULTS[reason].reaction is Reaction.NOTE
    assert not bench.controller.supervisor.half_speed and bench.commands_b["ArmKey"] == 0xA
    bench.dropped.clear()
    assert bench.drive(0, 0.08, 21) is Mode.ACTIVE and bench.reason == Reason.NONE


def test_receiver_without_a_fix_is_a_lost_position():
    bench = Bench(AORO).boot()
    bench.changed["PositionRapidUpdate"] = {"Latitude": None, "Longitude": None}
    assert bench.run(21) is Mode.STANDBY and bench.reason == Reason.GNSS_LOST


BUSES = pytest.mark.parametrize(("settings", "prefix"), [(SETTINGS, ""), (AORO, "machine_")], ids=["crane0", "mach0"])


@BUSES
@pytest.mark.parametrize("prepare", [Bench.boot, Bench.armed, Bench.active])
def test_a_foreign_controller_is_detected_in_every_mode(settings, prefix, prepare):
    bench = prepare(Bench(settings))
    name = "VehCmd" if prefix else "ValveCmdA"
    getattr(bench, f"{prefix}extra").append((CODECS[name].key, bytes(8)))
    bench.tick()
    assert bench.mode is Mode.FAULT and bench.reason == Reason.FOREIGN_CONTROLLER and bench.neutral
    assert bench.controller.supervisor.detail == bool(prefix)


def test_lost_address_stops_the_machine():
    bench = Bench(AORO).active()
    bench.machine_extra.append((MACHINE.message("AddressClaim").key, bytes(8)))
    assert bench.until(Reason.ADDRESS_LOST) * T <= FAULTS[Reason.ADDRESS_LOST].bound_ms * MS
    assert bench.run(14) is Mode.FAULT and bench.neutral


@BUSES
@pytest.mark.parametrize(
    ("state", "reason", "mode"),
    [
        (3, Reason.BUS_OFF, Mode.FAULT),
        (4, Reason.BUS_DOWN, Mode.FAULT),
        (2, Reason.BUS_PASSIVE, Mode.ACTIVE),
        (1, Reason.NONE, Mode.ACTIVE),
    ],
)
def test_bus_state(settings, prefix, state, reason, mode):
    bench = Bench(settings).active()
    bench.tick(**{f"{prefix}bus_state": state})
    assert bench.mode is mode and bench.reason == reason
    assert bench.controller.supervisor.detail == (bool(prefix) and reason is not Reason.NONE)
    assert bench.neutral is (mode is Mode.FAULT)


@pytest.mark.parametrize("prepare", [Bench.boot, Bench.armed])
def test_mach0_bus_off_latches_while_nothing_moves(prepare):
    bench = prepare(Bench(AORO))
    bench.tick(machine_bus_state=3)
    assert bench.mode is Mode.FAULT and bench.reason == Reason.BUS_OFF


def test_three_refused_sends_in_a_row_on_mach0_stop_and_two_do_not():
    bench = Bench(AORO).active()

    def send(refused):
        """Tick until the refusal of the next commands is seen."""
        while not bench.controller.outputs.machine_frames:
            bench.drive(0, 0.08, 1)
        bench.tick([bench.moving(0, 0.08)], machine_bus_refused=refused)

    for refused in (3, 6, 6, 9, 12):
        send(refused)
    assert bench.mode is Mode.ACTIVE
    begin = bench.count
    send(15)
    assert bench.reason == Reason.SEND_REFUSED and bench.mode is Mode.STOP
    assert bench.controller.supervisor.detail == 1
    assert 3 * (bench.count - begin) * T <= FAULTS[Reason.SEND_REFUSED].bound_ms * MS


def test_frames_of_an_overflowed_tick_of_mach0_are_not_used():
    bench = Bench(AORO).active()
    machine, crane = bench.controller.carrier_bus.inputs, bench.controller.crane_inputs
    while bench.count % 4:
        bench.drive(0, 0.08, 1)
    count, others = machine.count, crane.count
    bench.tick([bench.moving(0, 0.08)], machine_bus_dropped=3)
    assert machine.count == count and crane.count > others
    bench.drive(0, 0.08, 4)
    assert machine.count > count and bench.mode is Mode.ACTIVE


# -- a bus that comes back ----------------------------------------------------------------------------------

PREPARED = {"start": lambda b: b.run(60), "standby": Bench.boot, "armed": Bench.armed, "active": Bench.active}


@pytest.mark.parametrize("prepare", PREPARED.values(), ids=PREPARED)
def test_recovery_of_crane0_forgets_all_inputs(prepare):
    bench = Bench()
    prepare(bench)
    received = bench.controller.crane_inputs
    count = received.count
    bench.encoders[3].writes.clear()
    outputs = bench.tick(bus_recoveries=1)
    assert bench.mode is Mode.FAULT and bench.reason == Reason.BUS_OFF and bench.neutral
    assert received.count == count, "frames received with the recovery are not used"
    assert all(state.values is None for state in received.messages)
    assert not any(received.nodes.operational(n, bench.now_ns) for n in received.nodes.by_number)
    silenced = [data[1] for key, data in outputs.frames if key == 0 and data[0] == 0x80]
    assert len(silenced) == 1 and silenced[0] in bench.encoders, "an encoder is silenced before it is set up again"
    bench.run(2)
    assert received.guard.values is None, "two good frames qualify"
    assert bench.run(200) is Mode.FAULT and (0x1800, 2, 1) in bench.encoders[3].writes
    assert bench.press(OperatorAction.ARM) is Mode.FAULT
    bench.press(OperatorAction.RESET)
    assert bench.press(OperatorAction.ARM) is Mode.ARMED


def test_device_swapped_during_bus_off_is_detected():
    bench = Bench().boot()
    bench.encoders[2].objects[0x1018, 1] = 8
    bench.tick(bus_recoveries=1)
    bench.run(200)
    bench.press(OperatorAction.RESET)
    bench.run(100)
    assert bench.reason == Reason.NODE_IDENTITY and bench.controller.supervisor.detail == 2


def test_reset_does_not_skip_start_up_after_recovery():
    bench = Bench().active()
    bench.tick(bus_recoveries=1)
    assert bench.press(OperatorAction.RESET) is Mode.BOOT
    assert bench.press(OperatorAction.ARM) is Mode.BOOT
    assert bench.run(150) is Mode.STANDBY and bench.reason == Reason.NONE


def test_node_silent_after_recovery_is_detected():
    bench = Bench().boot()
    bench.silent_nodes.add(0x10)
    bench.tick(bus_recoveries=1)
    bench.run(150)
    bench.press(OperatorAction.RESET)
    bench.run(2)
    assert bench.reason == Reason.NODE_NOT_OPERATIONAL and bench.controller.supervisor.detail == 0x10
    bench.extra.append(heartbeat_frame(0x10, 5))
    bench.run(1)
    assert bench.reason == Reason.NONE


@pytest.mark.parametrize("prepare", PREPARED.values(), ids=PREPARED)
def test_recovery_of_mach0_forgets_all_inputs(prepare):
    bench = Bench(AORO)
    prepare(bench)
    machine = bench.controller.carrier_bus.inputs
    count, start_up = machine.count, bench.controller.startup.complete
    bench.machine_sent.clear()
    bench.tick(machine_bus_recoveries=1)
    assert bench.mode is Mode.FAULT and bench.reason == Reason.BUS_OFF and bench.neutral
    assert bench.controller.supervisor.detail == 1
    assert machine.count == count and all(state.values is None for state in machine.messages)
    assert bench.machine_sent[0][0] == MACHINE.message("AddressClaim").key
    assert bench.controller.startup.complete is start_up, "crane0 is not affected"
    bench.run(150)
    bench.press(OperatorAction.RESET)
    assert bench.press(OperatorAction.ARM) is Mode.ARMED


@pytest.mark.parametrize(("which", "bus"), [("bus", 0), ("machine_bus", 1)])
def test_three_recoveries_within_a_minute_refuse_arming_for_a_minute(which, bus):
    bench = Bench(AORO).boot()
    for k in range(1, 4):
        bench.run(150, **{f"{which}_recoveries": k})
        bench.press(OperatorAction.RESET)
        assert bench.run(2) is Mode.STANDBY
        assert bench.reason == (Reason.BUS_UNSTABLE if k == 3 else Reason.NONE)
    last_ns = bench.now_ns - 152 * T
    assert bench.controller.supervisor.detail == bus
    assert bench.press(OperatorAction.ARM) is Mode.STANDBY and bench.controller.gate.refusal is Reason.BUS_UNSTABLE
    monitor = bench.controller.supervisor._bus_monitors[bus]
    assert not monitor.usable(last_ns + 60 * S - 1) and monitor.usable(last_ns + 60 * S)


def test_recoveries_far_apart_do_not_refuse_arming():
    bench = Bench().boot()
    monitor = bench.controller.crane_bus_monitor
    reading = bench.inputs.bus
    for k in range(1, 12):
        reading.recoveries = k
        monitor.update(reading, True, k * 31 * S)
        assert monitor.usable(k * 31 * S)
    reading.recoveries = 14  # three between two ticks
    monitor.update(reading, True, 400 * S)
    assert not monitor.usable(459 * S)
