"""The plant's faults by name: each begins on a running plant and returns what ends it.

Lockstep runs call `begin` directly, a live plant on request (`sim.process.live_plant`).  Names and PX4's words are in
`hil.faults.table`; here is only what the plant does.  Equal seeds and moments give equal bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from random import Random
from typing import Final

import msgspec

from can_dbc.dbc.codec import Database, MessageCodec, load
from can_dbc.messages.crane import ModeSwitch
from can_dbc.protocols.canopen import NMT_ID, NmtCommand
from machine.crane_nodes import CraneNode
from machine.profile import Profile
from runtime.errors import ConfigError
from sim import faults
from sim.emulation import EmulatedMachine
from sim.errors import PlantError
from sim.nodes.gnss import Fix, GnssNode
from sim.plant import Plant

End = Callable[[], None]
ENCODER_MESSAGES: Final = {
    "slew": "EncSlew",
    "lift": "EncLift",
    "tilt": "EncTilt",
    "ext": "EncExt",
    "rot": "EncRot",
    "articulation": "EncArtic",
}


@dataclass(frozen=True, slots=True)
class PlantFault:
    """One fault: its name, the part it acts on (joint, message, node or position of the mode switch, "" where there is
    only one), its size in the unit of its name in `BEGINNERS`, and the seed of what it draws.
    """

    name: str
    part: str = ""
    size: float = 0.0
    seed: int = 0


def begin(plant: EmulatedMachine, fault: PlantFault, now_ns: int) -> End:
    """Begin a fault; returns what ends it.

    Raises:
        PlantError: this machine has no such fault or part.
    """
    beginner = BEGINNERS.get(fault.name)
    if beginner is None:
        raise PlantError(
            "fault.unknown", f"the plant has no fault {fault.name!r}; `timberhand inject --list` shows those it has"
        )
    return beginner(plant, fault, now_ns)


def _encoder(**error: float | bool) -> Callable[[EmulatedMachine, PlantFault, int], End]:
    """Make errors of one encoder's reading; a value of NaN stands for the fault's size."""

    def start(plant: EmulatedMachine, fault: PlantFault, now_ns: int) -> End:
        encoder = plant.encoders.get(fault.part)
        if encoder is None:
            raise PlantError(
                "fault.no-encoder",
                f"{plant.profile.name} has no encoder {fault.part!r}, only {', '.join(plant.encoders)}",
            )
        sized = {k: fault.size if isinstance(v, float) and math.isnan(v) else v for k, v in error.items()}
        pivot = encoder.measure(now_ns) if "scale" in error else 0.0
        encoder.fault = faults.EncoderFault(since_ns=now_ns, pivot=pivot, **sized)  # type: ignore[arg-type]

        def end() -> None:
            encoder.fault = None

        return end

    return start


def _identity(plant: EmulatedMachine, fault: PlantFault, now_ns: int) -> End:
    """Let another device answer under the node number; it boots."""
    encoder = plant.encoders[fault.part]
    encoder.spec = msgspec.structs.replace(encoder.spec, device_type=encoder.spec.device_type ^ 1)
    plant._deliver_crane(NMT_ID, bytes((NmtCommand.RESET_NODE, encoder.spec.node)), now_ns)
    return _nothing


def _spool(kind: str) -> Callable[[EmulatedMachine, PlantFault, int], End]:
    def start(plant: EmulatedMachine, fault: PlantFault, now_ns: int) -> End:
        table: dict[str, float] = getattr(plant.spool_faults, kind)
        table[fault.part] = fault.size

        def end() -> None:
            table.pop(fault.part, None)

        return end

    return start


def _burst(plant: EmulatedMachine, fault: PlantFault, now_ns: int) -> End:
    """Burst the hose of the chamber with the higher pressure, which loses its oil: that one carries the load."""
    hydraulics = _physical(plant, fault).world.hydraulics
    if fault.part not in hydraulics.names:
        raise PlantError("fault.no-function", f"{plant.profile.name} has no hydraulic function {fault.part!r}")
    pressure_a, pressure_b = hydraulics.pressures_pa[fault.part]
    hose = (fault.part, "a" if pressure_a >= pressure_b else "b")
    hydraulics.burst.add(hose)
    return lambda: hydraulics.burst.discard(hose)


def _overload(plant: EmulatedMachine, fault: PlantFault, now_ns: int) -> End:
    """Hang a mass [kg] on the rotator, as from a log that is caught by another."""
    world = _physical(plant, fault).world
    body, link = world.crane.body, world.crane.link["rotator"]
    before = world.client.getDynamicsInfo(body, link)[0]
    world.client.changeDynamics(body, link, mass=before + fault.size)
    return lambda: world.client.changeDynamics(body, link, mass=before)


def _tilt(plant: EmulatedMachine, fault: PlantFault, now_ns: int) -> End:
    """Let the ground give way on one side: roll [rad], + right side down."""
    plant.tilt_rad = (fault.size, 0.0)

    def end() -> None:
        plant.tilt_rad = (0.0, 0.0)

    return end


def _node_reset(plant: EmulatedMachine, fault: PlantFault, now_ns: int) -> End:
    """Reset a node as after a drop of its supply: boot-up, and everything that it knew is gone."""
    node = CraneNode[fault.part.upper().replace("-", "_")]
    reset = bytes((NmtCommand.RESET_NODE, node))
    plant._deliver_crane(NMT_ID, reset, now_ns)
    return _nothing


def _estop(plant: EmulatedMachine, fault: PlantFault, now_ns: int) -> End:
    plant.estop.press()
    return _nothing


def _estop_wire(plant: EmulatedMachine, fault: PlantFault, now_ns: int) -> End:
    """Break the wire of one of the two normally closed contacts."""
    codec = message(plant.profile, "EstopStat")[1]
    channel = "ChannelA" if fault.seed % 2 else "ChannelB"
    return plant.tap.add(plant.profile.crane_bus, codec.key, faults.rewritten(codec, {channel: 0}))


def _person(plant: EmulatedMachine, fault: PlantFault, now_ns: int) -> End:
    codec = message(plant.profile, "EstopStat")[1]
    return plant.tap.add(plant.profile.crane_bus, codec.key, faults.rewritten(codec, {"Person": 1}))


def _lever(plant: EmulatedMachine, fault: PlantFault, now_ns: int) -> End:
    plant.estop.move_lever(True)
    return lambda: plant.estop.move_lever(False)


def _turn(plant: EmulatedMachine, fault: PlantFault, now_ns: int) -> End:
    """Turn the mode switch to a position as the operator does, and back at the end."""
    before = plant.estop.mode_switch
    try:
        plant.estop.turn(ModeSwitch[fault.part.upper().replace("-", "_")])
    except KeyError:
        known = ", ".join(switch.name.lower().replace("_", "-") for switch in ModeSwitch)
        text = f"the mode switch has no position {fault.part!r}; use one of {known}"
        raise PlantError("fault.no-position", text) from None
    return lambda: plant.estop.turn(before)


def _gnss(change: Callable[[GnssNode, PlantFault], End]) -> Callable[[EmulatedMachine, PlantFault, int], End]:
    def start(plant: EmulatedMachine, fault: PlantFault, now_ns: int) -> End:
        if plant.gnss is None:
            raise PlantError("fault.no-gnss", f"{plant.profile.name} has no GNSS receiver")
        return change(plant.gnss, fault)

    return start


def _silence(gnss: GnssNode, fault: PlantFault) -> End:
    gnss.silent = True

    def end() -> None:
        gnss.silent = False

    return end


def _jump(gnss: GnssNode, fault: PlantFault) -> End:
    angle = Random(fault.seed).uniform(0.0, math.tau)
    gnss.jump_m = (fault.size * math.cos(angle), fault.size * math.sin(angle))

    def end() -> None:
        gnss.jump_m = (0.0, 0.0)

    return end


def _fix(gnss: GnssNode, fault: PlantFault) -> End:
    gnss.set_fix(Fix.SINGLE)
    return lambda: gnss.set_fix(Fix.RTK_FIXED)


def _heading(gnss: GnssNode, fault: PlantFault) -> End:
    gnss.heading_error_rad = math.pi

    def end() -> None:
        gnss.heading_error_rad = 0.0

    return end


def _heading_frozen(gnss: GnssNode, fault: PlantFault) -> End:
    gnss.heading_frozen = True

    def end() -> None:
        gnss.heading_frozen = False

    return end


@cache
def database(name: str) -> Database:
    """Return a shipped database, compiled once per process."""
    return load(name)


def message(profile: Profile, name: str) -> tuple[str, MessageCodec]:
    """Find the bus and codec of a message of a machine.

    Raises:
        PlantError: no bus of this machine has it.
    """
    buses = [(profile.crane_bus, "crane")]
    if profile.machine_bus:
        buses += [(profile.machine_bus, "machine"), (profile.machine_bus, "gnss")]
    for bus, kind in buses:
        try:
            return bus, database(kind).message(name)
        except ConfigError:
            continue
    raise PlantError("fault.no-message", f"{profile.name} has no message {name!r}; take a name of its DBC files")


def _frames(
    make: Callable[[PlantFault, MessageCodec], faults.Effect],
) -> Callable[[EmulatedMachine, PlantFault, int], End]:
    """Make an effect on the frames of one message."""

    def start(plant: EmulatedMachine, fault: PlantFault, now_ns: int) -> End:
        bus, codec = message(plant.profile, fault.part)
        return plant.tap.add(bus, codec.key, make(fault, codec))

    return start


def _stuck(plant: EmulatedMachine, fault: PlantFault, now_ns: int) -> End:
    bus, codec = message(plant.profile, fault.part)
    return plant.tap.repeat(bus, codec.key)


def _late(plant: EmulatedMachine, fault: PlantFault, now_ns: int) -> End:
    bus, codec = message(plant.profile, fault.part)
    return plant.tap.delay(bus, codec.key, round(fault.size * 1e6))


def _foreign(fault: PlantFault, codec: MessageCodec) -> faults.Effect:
    if codec.data_ids is None:
        raise PlantError("fault.no-data-id", f"{codec.name} has no Data IDs to mistake; choose a protected message")
    return faults.masqueraded(bytes(b ^ 0x5A for b in codec.data_ids))


def _physical(plant: EmulatedMachine, fault: PlantFault) -> Plant:
    if not isinstance(plant, Plant):
        raise PlantError("fault.no-physics", f"{fault.name} needs the plant with physics, not the kinematic machine")
    return plant


def _nothing() -> None:
    """Do nothing: what has happened cannot be undone."""


SIZE: Final = math.nan
BEGINNERS: Final[dict[str, Callable[[EmulatedMachine, PlantFault, int], End]]] = {
    "encoder-stuck": _encoder(frozen=True),
    "encoder-jump": _encoder(offset=SIZE),
    "encoder-drift": _encoder(drift_per_s=SIZE),
    "encoder-noise": _encoder(noise_factor=SIZE),
    "encoder-scale": _encoder(scale=SIZE),
    "encoder-identity": _identity,
    "message-off": _frames(lambda fault, codec: faults.silent),
    "message-stuck": _stuck,
    "message-garbage": _frames(lambda fault, codec: faults.garbage(Random(fault.seed))),
    "message-intermittent": _frames(lambda fault, codec: faults.intermittent(Random(fault.seed), fault.size)),
    "message-slow": _frames(lambda fault, codec: faults.every(max(2, round(fault.size)))),
    "message-delayed": _late,
    "message-masquerade": _frames(_foreign),
    "valve-stuck": _spool("stuck"),
    "valve-drift": _spool("bias"),
    "valve-gain": _spool("gain"),
    "hose-burst": _burst,
    "load-overload": _overload,
    "ground-tilt": _tilt,
    "node-reset": _node_reset,
    "estop-pressed": _estop,
    "estop-wire": _estop_wire,
    "person-in-zone": _person,
    "lever-moved": _lever,
    "mode-switch": _turn,
    "gnss-off": _gnss(_silence),
    "gnss-jump": _gnss(_jump),
    "gnss-single": _gnss(_fix),
    "heading-flip": _gnss(_heading),
    "heading-stuck": _gnss(_heading_frozen),
}
"""Size: rad or m (jump), per s (drift), factor (noise, scale, gain), ms (delayed), share of frames lost (intermittent),
every n-th frame (slow), -1..1 of the spool (stuck, drift), kg (overload), rad (tilt), m (gnss-jump)."""
