"""An inertial sensor on the grapple: lean against the vertical and its rate, in the crane's plane and across it.

It models a MEMS gyroscope and accelerometer with a built-in filter: both angles with a fixed mounting and filter
error, white noise on angles and rates, all delayed.  The numbers are assumed.  Noise comes from a random stream of its
own, so a machine with the sensor differs from one without it in nothing else.
"""

from __future__ import annotations

import random
from collections import deque
from typing import Final

from can_dbc.dbc.codec import Database
from machine.profile import Imu
from sim.nodes import Outbox
from sim.nodes.device import Device
from sim.nodes.messages import MS, PeriodicTimer, ProtectedMessage

PERIOD_NS: Final = 10 * MS
LATENCY_NS: Final = 20 * MS
MOUNTING_RAD: Final = 0.003
LEAN_NOISE_RAD: Final = 0.001
RATE_NOISE_RAD_S: Final = 0.004

Pair = tuple[float, float]


class ImuNode(Device):
    """``observe`` feeds the true lean [rad] (radial, tangential) every physics step of ``step_ns``."""

    def __init__(self, spec: Imu, database: Database, outbox: Outbox, step_ns: int, seed: int) -> None:
        super().__init__(spec.node, outbox)
        self._message, self._period = ProtectedMessage(database, spec.message), PeriodicTimer(PERIOD_NS)
        self._rng = random.Random(f"imu {seed}")
        self._step_s = step_ns * 1e-9
        self._history: deque[Pair] = deque(maxlen=2 + max(0, round(LATENCY_NS / step_ns)))
        self._mounting = (self._rng.gauss(0.0, MOUNTING_RAD), self._rng.gauss(0.0, MOUNTING_RAD))
        self.silent = False
        """Its cable is cut: it sends nothing."""

    def observe(self, lean_rad: Pair) -> None:
        """Record the true lean at the end of a step."""
        self._history.append(lean_rad)

    def tick(self, now_ns: int) -> None:
        if not self.silent:
            super().tick(now_ns)

    def cycle(self, now_ns: int) -> None:
        if not self._period.due(now_ns) or len(self._history) < 2:
            return
        off = self._rng.gauss
        before, lean = self._history[0], self._history[1]
        leans = [a + m + off(0.0, LEAN_NOISE_RAD) for a, m in zip(lean, self._mounting, strict=True)]
        rates = [(a - b) / self._step_s + off(0.0, RATE_NOISE_RAD_S) for a, b in zip(lean, before, strict=True)]
        self.outbox.append(self._message.frame(0, *leans, *rates))
