"""Faults of a bus as `hil.wire.faults.Fault`: the same for the core of a lockstep run and for a live wire daemon."""

from __future__ import annotations

from typing import Final

from can_dbc.frame import EXTENDED, EXTENDED_MASK
from can_dbc.protocols.e2e import protect
from hil.faults.table import Order
from hil.wire.faults import Fault, Kind
from machine.profile import Profile
from runtime.errors import InputRefused
from sim.errors import PlantError
from sim.plant_faults import database, message

FOREIGN_PERIOD_NS: Final = 5_000_000
BABBLE_KEY: Final = 0x001
"""Wins every arbitration against the machine's nodes, SYNC and NMT apart."""
CONTROLLER: Final = "controller"
"""How the controller names itself on a wire."""
_EXACT: Final = EXTENDED | EXTENDED_MASK


def wire_fault(order: Order, profile: Profile, start_ns: int, end_ns: int) -> tuple[str, Fault]:
    """Return the bus and the fault that carries out an order.

    Raises:
        InputRefused: this machine has no such bus or message, or the fault is none of a bus.
    """
    if order.fault in ("bus-drop", "bus-corrupt", "bus-repeat"):
        try:
            bus, codec = message(profile, order.part)
        except PlantError as error:
            raise InputRefused(error.code, str(error)) from None
        kind = {"bus-drop": Kind.DROP, "bus-corrupt": Kind.CORRUPT, "bus-repeat": Kind.REPEAT}[order.fault]
        probability = order.sized() if kind is Kind.DROP else 1.0
        shift_ns = round(order.sized() * 1e6) if kind is Kind.REPEAT else 0
        count = 2 if kind is Kind.CORRUPT else 1
        # Less than a period is meant for one frame: late by a few others, the next one may start within it, too.
        most = 1 if end_ns - start_ns < codec.cycle_time_ns else 0
        return bus, Fault(
            kind, start_ns, end_ns, codec.key, _EXACT, None, probability, shift_ns, count, seed=order.seed, most=most
        )
    if order.part not in (profile.crane_bus, profile.machine_bus):
        raise InputRefused("fault.no-bus", f"{profile.name} has no bus {order.part!r}")
    return order.part, _bus_fault(order, start_ns, end_ns, order.part == profile.crane_bus)


def _bus_fault(order: Order, start_ns: int, end_ns: int, crane: bool) -> Fault:
    match order.fault:
        case "bus-babble":
            return Fault(Kind.BABBLE, start_ns, end_ns, BABBLE_KEY, node="babbler")
        case "bus-cut":
            return Fault(Kind.CUT, start_ns, end_ns)
        case "bus-stub":
            return Fault(Kind.CUT, start_ns, end_ns, node=CONTROLLER)
        case "bus-errors":
            return Fault(Kind.ERROR, start_ns, end_ns, node=CONTROLLER, probability=order.sized(), seed=order.seed)
        case "bus-foreign":
            codec = database("crane").message("ValveCmdA") if crane else database("machine").message("VehCmd")
            assert codec.data_ids is not None
            data = protect(bytes(codec.length), 0, codec.data_ids)
            period_ns = FOREIGN_PERIOD_NS
            return Fault(Kind.BABBLE, start_ns, end_ns, codec.key, node="foreign", shift_ns=period_ns, data=data)
    raise InputRefused("fault.not-on-bus", f"{order.fault} is no fault of a bus")
