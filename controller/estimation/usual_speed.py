"""The speed limits of ordinary cranes, by which monitors scale how far a joint moves without its valve.

Oil yields, steel bends, a grapple swings and a log that is let go relieves the boom: the joint moves by as much whether
its valve lets little oil through or much.  On a machine that is slower than these limits the monitors allow the ways of
a machine that has them; a third of them took an unloaded boom for a runaway (measured on the plant).
"""

from __future__ import annotations

from typing import Final

USUAL_SPEED: Final = (0.35, 0.15, 0.28, 0.25, 1.0)
"""In `machine.joints.Joint` order [rad/s, EXT m/s]: the slower one of the two shipped machines."""
