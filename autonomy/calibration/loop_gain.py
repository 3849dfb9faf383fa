"""Loop gains that a measured valve bears: the greatest ``kp_1_s`` with enough margin.

A joint's loop is its gain, the joint that integrates, and what comes between: dead time, the spool and the oil::

    L(s) = kp / s * exp(-s (dead time + oil)) / (1 + 2 z s / w + s^2 / w^2)        w = 2 z / lag, z = 0.8

The controller's delay compensation is left out, as it must not be needed for stability: it is only as good as the
profile.  The limits of margin are those of `timberhand bench loop-design` (docs/loop-design.md), which also knows the
mechanics; the product of gain and dead time stays a little below what a profile may have (`machine.loading.checks`).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from autonomy.calibration.result import JointResult
from machine.loading.checks import MAX_GAIN_DELAY
from machine.profile import JointSpec

PHASE_MARGIN_DEG, GAIN_MARGIN_DB = 40.0, 6.0
SPOOL_ZETA: Final = 0.8
OIL_BOUNDS_S: Final = (0.02, 0.1)
"""Delay of oil and pump between spool and joint; where a fit tells more, it is a transient's."""
BELOW_MOST: Final = 0.9
"""Share of the greatest product of gain and dead time up to which a gain is lowered."""
DECIMALS: Final = 2
_W_RAD_S: Final = np.geomspace(0.05, 60.0, 1200)


def margins(kp_1_s: float, delay_s: float, lag_s: float, oil_s: float) -> tuple[float, float]:
    """Compute the phase margin [deg] and the gain margin [dB] of a joint's loop."""
    w = _W_RAD_S
    natural = 2.0 * SPOOL_ZETA / max(lag_s, 1e-3)
    spool = 1.0 - (w / natural) ** 2 + 2j * SPOOL_ZETA * w / natural
    size = kp_1_s / w / np.abs(spool)
    phase = -0.5 * np.pi - w * (delay_s + oil_s) - np.unwrap(np.angle(spool))
    crosses, turns = int(np.argmax(size < 1.0)), int(np.argmax(phase < -np.pi))
    return float(np.degrees(np.pi + phase[crosses])), float(-20.0 * np.log10(size[turns]))


def borne_gain_1_s(spec: JointSpec, r: JointResult) -> float:
    """Return the profile's gain, or the greatest below it that the measured valve bears, 1/s."""
    kp = spec.law.kp_1_s
    if r.delay is None:
        return kp
    delay_s, lag_s = r.delay.delay_s, r.delay.lag_s
    low, high = OIL_BOUNDS_S
    oil_s = min(max(low, *r.valve.lags_s), high)

    def bears(gain_1_s: float) -> bool:
        phase_deg, gain_db = margins(gain_1_s, delay_s, lag_s, oil_s)
        return phase_deg >= PHASE_MARGIN_DEG and gain_db >= GAIN_MARGIN_DB

    if kp * delay_s <= MAX_GAIN_DELAY and bears(kp):
        return kp
    kp = min(kp, BELOW_MOST * MAX_GAIN_DELAY / delay_s)
    step = 10.0**-DECIMALS
    rounded_gain_1_s = int(kp / step) * step
    while rounded_gain_1_s > step and not bears(rounded_gain_1_s):
        rounded_gain_1_s -= step
    return round(rounded_gain_1_s, DECIMALS)
