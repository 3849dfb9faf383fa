"""The CANopen nodes of crane0 that every machine has; the encoders' numbers are in the profile.

`controller.guard` imports nothing of this package and states its own number itself.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final


class CraneNode(IntEnum):
    """Node numbers (CiA 301)."""

    SAFETY_MODULE = 0x01
    VALVES = 0x10
    PRESSURES_A = 0x20
    PRESSURES_B = 0x21
    PRESSURES_C = 0x22
    GUARD = 0x7D
    CONTROLLER = 0x7E


PRESSURE_NODES: Final = (CraneNode.PRESSURES_A, CraneNode.PRESSURES_B, CraneNode.PRESSURES_C)

NODE_NAMES: Final[dict[int, str]] = {
    CraneNode.SAFETY_MODULE: "the safety module",
    CraneNode.VALVES: "the valve node",
    CraneNode.PRESSURES_A: "pressure module A",
    CraneNode.PRESSURES_B: "pressure module B",
    CraneNode.PRESSURES_C: "pressure module C",
    CraneNode.GUARD: "the guard",
}
"""For the operator."""
