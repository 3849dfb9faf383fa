"""Pressure monitor: has a chamber of a cylinder lost the oil that carries its load?  (docs/reference/safety.md case 20)

A hose that bursts lets the oil of its chamber out within a few milliseconds: a half-inch hose passes some 7 l/s at
40 bar, and the compressed oil of a chamber of 3 l is 14 ml.  The joint tells it only when the load has fallen for a
while; the pressures tell it at once.  A chamber has burst when within three frames (15 ms) its pressure falls from
at least `LOADED_BAR` below `LOST_SHARE` of that, stays there for `LOST_NS`, and the other chamber of the same cylinder
does not rise by `RISE_BAR` meanwhile.  The last one tells a loss of oil from a loss of load: a load that is
dropped, or a valve that reverses, unloads one chamber and presses on the other, but a burst lets the piston run away
from both.

Margins, from the plant with physics: swings of all joints, log jobs and calibrations of individual machines, 620 s of
work on either crane: no chamber of lift or tilt fell below 0.84 of its pressure within 20 ms (at most 240 bar/s), none
of telescope or slew below 0.67; a burst of 28..45 bar falls below 0.10 in one frame (5000 bar/s and more) and stays
below 0.16.  Loads that drop while levers are thrown about, with ends of strokes hit at full spool, do halve a pressure
in 20 ms, and the other chamber mostly rises by 3 to 40 bar then: 180 s of that, which no law does, hold 7 false bursts
(telescope 5, tilt 1, slew 1).

Blind: a chamber below `LOADED_BAR`, which carries next to nothing, and a leak so small that the pressure takes longer;
both are seen by the joint's motion (`controller.joint_watch`).  A transducer with a broken wire sends an error, no
pressure, and is no burst.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from controller.bus_io import MessageState, Signal

LOADED_BAR: Final = 15.0
LOST_SHARE: Final = 0.4
LOST_NS: Final = 20_000_000
RISE_BAR: Final = 2.0
GAP_NS: Final = 30_000_000
"""Pressures that are farther apart than this are not compared; frames come every 5 ms."""
NO_FUNCTION: Final = -1
_NEITHER, _A, _B = 0, 1, 2


class CylinderMonitor:
    """The two chambers of one cylinder or motor; ``before_bar`` and ``now_bar`` are those of the last loss."""

    __slots__ = (
        "_a1",
        "_a2",
        "_a3",
        "_b1",
        "_b2",
        "_b3",
        "_last_ns",
        "_lost",
        "_other_bar",
        "_since_ns",
        "before_bar",
        "now_bar",
    )

    def __init__(self) -> None:
        self.before_bar = self.now_bar = 0.0
        self.reset()

    def reset(self) -> None:
        """Reset as if nothing were known of the pressures."""
        self._a1 = self._a2 = self._a3 = self._b1 = self._b2 = self._b3 = 0.0
        self._lost = _NEITHER
        self._last_ns = self._since_ns = 0
        self._other_bar = 0.0

    def step(self, a_bar: float, b_bar: float, stamp_ns: int) -> bool:
        """Judge the pressures of a new frame: whether a chamber has burst."""
        if stamp_ns - self._last_ns > GAP_NS:
            self.reset()
        self._last_ns = stamp_ns
        if self._lost == _NEITHER:
            before_a, before_b = max(self._a1, self._a2, self._a3), max(self._b1, self._b2, self._b3)
            if before_a >= LOADED_BAR and a_bar < LOST_SHARE * before_a:
                self._lost, self.before_bar, self._other_bar, self._since_ns = _A, before_a, self._b3, stamp_ns
            elif before_b >= LOADED_BAR and b_bar < LOST_SHARE * before_b:
                self._lost, self.before_bar, self._other_bar, self._since_ns = _B, before_b, self._a3, stamp_ns
        self._a1, self._a2, self._a3 = a_bar, self._a1, self._a2
        self._b1, self._b2, self._b3 = b_bar, self._b1, self._b2
        if self._lost == _NEITHER:
            return False
        lost_bar, other_bar = (a_bar, b_bar) if self._lost == _A else (b_bar, a_bar)
        if lost_bar >= LOST_SHARE * self.before_bar or other_bar > self._other_bar + RISE_BAR:
            self._lost = _NEITHER
            return False
        self.now_bar = lost_bar
        return stamp_ns - self._since_ns >= LOST_NS


class PressureMonitor:
    """All cylinders whose pressures are measured; `step` gives the function whose hose has burst."""

    __slots__ = ("_functions", "cylinders")

    def __init__(self, pairs: Sequence[tuple[MessageState, str, str] | None]) -> None:
        """``pairs`` are in ``Joint`` order: message and names of its two pressures, None where there are none."""
        self.cylinders = [CylinderMonitor() for _ in pairs]
        self._functions = tuple(
            (j, pair[0], Signal(pair[0], pair[1]), Signal(pair[0], pair[2]), self.cylinders[j])
            for j, pair in enumerate(pairs)
            if pair is not None
        )

    def reset(self) -> None:
        """Forget what the pressures did before an operator armed, by a hand lever or with the pump off."""
        for cylinder in self.cylinders:
            cylinder.reset()

    def step(self) -> int:
        """Judge the frames of this tick; the function that has burst, or `NO_FUNCTION`."""
        burst = NO_FUNCTION
        for j, state, signal_a, signal_b, cylinder in self._functions:
            if not state.fresh:
                continue
            a_bar, b_bar = signal_a.value(), signal_b.value()
            if a_bar is None or b_bar is None:
                cylinder.reset()
            elif cylinder.step(a_bar, b_bar, state.stamp_ns) and burst == NO_FUNCTION:
                burst = j
        return burst
