"""The modules that are compiled ahead of time: what runs in every tick of the controller.

The one list, for `timberhand compile` and for a compiled wheel (setup.py).  A module belongs here when it runs in the
tick, names no ``__file__``, and has no class that interpreted code subclasses.  Left out: modules on msgspec (timing
page, profile) and the classes of the buses, which mypyc does not make faster, and the guard, which stays on the
interpreter so that no fault of the compiler is in both (`runtime.compiled.stay_interpreted`).  Standard library only.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

CODECS_MODULE: Final = "can_dbc.dbc.compiled_codecs"
"""Generated for a build from the shipped databases (`can_dbc.dbc.ahead_of_time`); not in the sources."""
GENERATOR: Final = "can_dbc.dbc.ahead_of_time"
MODULES: Final = (
    "can_dbc.bus.batch",
    "can_dbc.bus.reconnector",
    "can_dbc.bus.wire_records",
    "can_dbc.messages.crane",
    "can_dbc.messages.datagrams",
    "can_dbc.messages.envelope",
    "can_dbc.messages.record_ring",
    "can_dbc.messages.tick_record",
    "can_dbc.messages.vehicle",
    "can_dbc.protocols.canopen",
    "can_dbc.protocols.e2e",
    "can_dbc.protocols.nmea2000",
    "can_dbc.timing.durations",
    "controller.bus_io",
    "controller.carrier.bus",
    "controller.carrier.dead_reckoning",
    "controller.carrier.monitors",
    "controller.carrier.vehicle",
    "controller.config",
    "controller.crane.inputs",
    "controller.crane.load",
    "controller.crane.motion",
    "controller.crane.outputs",
    "controller.crane.reference_governor",
    "controller.crane.spool_test_run",
    "controller.crane.startup",
    "controller.crane.trajectory_check",
    "controller.estimation.joint_estimator",
    "controller.estimation.joint_monitors",
    "controller.estimation.pressure_monitor",
    "controller.estimation.valve_monitors",
    "controller.joint_watch",
    "controller.laws.crane",
    "controller.laws.drive",
    "controller.laws.feedback",
    "controller.laws.grapple",
    "controller.laws.joint",
    "controller.laws.response",
    "controller.laws.suspension",
    "controller.laws.sway",
    "controller.laws.valve_map",
    "controller.operator_link",
    "controller.process.bus_link",
    "controller.process.loop",
    "controller.process.operator_socket",
    "controller.process.setpoint_port",
    "controller.process.tick_recording",
    "controller.process.timing",
    "controller.requests",
    "controller.state_report",
    "controller.step",
    "controller.supervisor",
    "controller.tick",
    "controller.transitions",
    "controller.valve_watch",
    "machine.geometry.carrier",
    "machine.geometry.kinematics",
    "machine.geometry.sag",
    "machine.sensing",
)


def file_of(module: str) -> Path:
    """Return the source file of a module below the root of the sources."""
    return Path(*module.split(".")).with_suffix(".py")
