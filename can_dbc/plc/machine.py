"""A machine that is not on CAN: four calls, and the bridge shows it to controller and guard as the nodes of crane0.

An entry point of the group ``timberhand.machines`` names a factory without arguments that returns a `Machine`;
``python -m controller.plc --machine NAME`` runs it.  `docs/how-to/extend.md` has an example.
"""

from __future__ import annotations

from typing import Final, Protocol

from can_dbc.plc.map import Command, Feedback

MACHINES: Final = "timberhand.machines"


class Machine(Protocol):
    """Your machine behind the bridge, in the role that ``[plc]`` of its profile names.

    The bridge calls `connect`, then 100 times a second `act` and `observe`, and `disconnect` at the end or after an
    error.  Each of them returns within some milliseconds; a machine that keeps the bridge waiting for 50 ms is stopped
    like one that is silent.  Each raises OSError when the machine cannot be reached, and is connected to again.
    """

    def connect(self) -> None:
        """Open what the machine is reached by; its valves stay neutral until the first command."""

    def act(self, command: Command) -> None:
        """Execute a command; it replaces the one before.

        The machine must bring its valves to neutral by itself when no command has come for 50 ms.
        """

    def observe(self) -> Feedback:
        """Return what the machine measures now.

        ``heartbeat`` counts its cycles: the machine is alive while it grows.  ``sampled_us`` is the time of the sample:
        the same time again is the same sample.  ``estop_frame`` is the safety module's own EstopStat.  ``accepted`` is
        ignored.
        """

    def disconnect(self) -> None:
        """Close it; may be called twice, and without `connect` before."""
