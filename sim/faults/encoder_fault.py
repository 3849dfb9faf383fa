"""What can be wrong with an encoder that still answers (docs/reference/safety.md section 5, cases 1 to 5)."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class EncoderFault:
    """Errors of the reading [rad, m], on top of the sensor's own.

    ``frozen``: the last reading is repeated while the time stamp runs.  ``offset`` jumps, ``drift_per_s`` grows from
    ``since_ns`` on, ``scale`` turns the reading about ``pivot`` (-1: wired the wrong way round), ``noise_factor``
    multiplies the noise.
    """

    frozen: bool = False
    offset: float = 0.0
    drift_per_s: float = 0.0
    since_ns: int = 0
    scale: float = 1.0
    pivot: float = 0.0
    noise_factor: float = 1.0

    def position(self, true: float, now_ns: int) -> float:
        """The position that the faulty sensor sees."""
        drifted = self.drift_per_s * (now_ns - self.since_ns) * 1e-9
        return self.pivot + self.scale * (true - self.pivot) + self.offset + drifted
