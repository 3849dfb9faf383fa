"""Where frames come from: a recording, a stereo camera, a socket.  One small protocol; perception knows no more."""

from __future__ import annotations

from typing import Protocol

from autonomy.perception.frame import Frame


class SourceError(ValueError):
    """A source that cannot be opened or read; the message says what is wrong and what to do."""


class CameraSource(Protocol):
    """A camera that is asked for frames."""

    def frame(self) -> Frame | None:
        """The newest frame; None when there is none yet, or none in time, or none left.

        Raises:
            SourceError: it gives none, and why.
        """
        ...

    def close(self) -> None:
        """Let go of it."""
        ...
