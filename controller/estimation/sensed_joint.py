"""A joint with an encoder on crane0: the encoder's newest sample corrects the joint's estimate."""

from __future__ import annotations

from typing import Final

from controller.bus_io import MessageState, Signal
from controller.estimation.joint_estimator import JointEstimator
from machine.profile import Encoder
from machine.sensing.encoder import EncoderScale

DITHER_SHARE: Final = 0.3
"""An encoder whose noise is at least this share of a count does not give the same count for long: of 20 samples in the
middle of a count all agree with a probability of 13 % at this share, and of 1e-8 at one count."""


class SensedJoint:
    """Message of the encoder, its scale, and the estimator that it corrects."""

    __slots__ = ("_counts", "_estimator", "_last", "_scale", "_state", "dithers", "unchanged")

    def __init__(self, state: MessageState, encoder: Encoder, estimator: JointEstimator) -> None:
        self._state, self._counts = state, Signal(state, "Position")
        self._scale, self._estimator = EncoderScale(encoder), estimator
        self._last = -1
        self.dithers = encoder.noise >= DITHER_SHARE * encoder.unit_per_count
        """Whether the same count again and again means that the encoder is frozen."""
        self.unchanged = 0
        """Samples in a row with the same count, after the first."""

    def update(self) -> None:
        """Use a sample of this tick; forget the estimate when the encoder's values are stale.  After `predict`."""
        state = self._state
        if state.fresh:
            counts = self._counts.value()
            self.unchanged = self.unchanged + 1 if counts == self._last else 0
            self._last = counts
            self._estimator.update(self._scale.position(counts), state.stamp_ns)
        elif state.values is None:
            self._estimator.reset()
            self.unchanged = 0
