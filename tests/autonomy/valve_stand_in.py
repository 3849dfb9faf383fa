"""A valve, its oil and its joint as closed forms, to make the tests that a calibration would have measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autonomy.calibration.spool_program import SpoolProgram
from autonomy.calibration.trace import FINE_FACTOR, GRID_S, SpoolTestRecord
from machine.joints import Joint

LEAD_S, TAIL_S = 0.2, 0.6


@dataclass(frozen=True)
class StandIn:
    """One function: shares of full command, speeds at full command, seconds."""

    deadbands: tuple[float, float] = (0.13, 0.11)
    hysteresis: float = 0.02
    full_speeds: tuple[float, float] = (0.45, 0.55)
    exponent: float = 1.04
    delay_s: float = 0.093
    spool_rad_s: float = 40.0
    spool_zeta: float = 0.8
    ring_rad_s: float = 14.0
    ring_zeta: float = 0.3
    noise: float = 2e-4
    count: float = 3.8e-4

    def run(
        self, joint: Joint, side: int, kind: str, program: SpoolProgram, start: float, seed: int = 0
    ) -> SpoolTestRecord:
        """What the bus would have said while the program ran."""
        h = GRID_S / FINE_FACTOR
        steps = int((LEAD_S + program.duration_s + TAIL_S) / h)
        delay = round(self.delay_s / h)
        tick = round(GRID_S / h)
        times = np.arange(steps) * h
        command = np.array([program.at((i // tick * tick) * h - LEAD_S) / 100.0 for i in range(steps)])
        delayed = np.concatenate([np.zeros(delay), command])[:steps]
        spool = speed = play = 0.0
        oil = joint_at = joint_speed = start
        joint_speed = 0.0
        spools, positions = np.empty(steps), np.empty(steps)
        half = self.hysteresis / 2
        for i in range(steps):
            w = self.spool_rad_s
            speed += h * (w * w * (delayed[i] - spool) - 2 * self.spool_zeta * w * speed)
            spool += h * speed
            play = max(spool - half, min(spool + half, play))
            index = 0 if play >= 0 else 1
            opening = max(0.0, abs(play) - self.deadbands[index]) / (1 - half - self.deadbands[index])
            oil += h * np.sign(play) * self.full_speeds[index] * opening**self.exponent
            r = self.ring_rad_s
            joint_speed += h * (r * r * (oil - joint_at) - 2 * self.ring_zeta * r * joint_speed)
            joint_at += h * joint_speed
            spools[i], positions[i] = spool, joint_at
        grid = slice(None, None, tick)
        rng = np.random.default_rng(seed)
        position = positions[grid] + rng.normal(0.0, self.noise, len(positions[grid]))
        fine = command[:: tick // FINE_FACTOR]
        count = len(position)
        # The last of every grid step's fine commands is the one at the grid's time.
        shifted = np.concatenate([np.zeros(FINE_FACTOR - 1), fine])[: count * FINE_FACTOR]
        return SpoolTestRecord(
            joint,
            side,
            kind,
            times[grid],
            command[grid],
            shifted,
            np.round(spools[grid] / 0.0005) * 0.0005,
            np.round(position / self.count) * self.count,
        )
