"""A joint with an encoder on crane0: the encoder's newest sample corrects the joint's estimate."""

from __future__ import annotations

from controller.bus_io.message_state import MessageState, Signal
from controller.estimation.joint_estimator import JointEstimator
from machine.profile import Encoder
from machine.sensing.encoder import EncoderScale


class SensedJoint:
    """Message of the encoder, its scale, and the estimator that it corrects."""

    __slots__ = ("_counts", "_estimator", "_scale", "_state")

    def __init__(self, state: MessageState, encoder: Encoder, estimator: JointEstimator) -> None:
        self._state, self._counts = state, Signal(state, "Position")
        self._scale, self._estimator = EncoderScale(encoder), estimator

    def update(self) -> None:
        """Use a sample of this tick; forget the estimate when the encoder's values are stale.  After `predict`."""
        state = self._state
        if state.fresh:
            self._estimator.update(self._scale.position(self._counts.value()), state.stamp_ns)
        elif state.values is None:
            self._estimator.reset()
