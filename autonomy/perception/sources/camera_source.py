"""The protocol of a source of camera frames: a frame folder, a stereo camera or a socket."""

from __future__ import annotations

from typing import Protocol

from autonomy.perception.camera.frame import RgbdFrame


class CameraSource(Protocol):
    """A camera that delivers frames on request."""

    def frame(self) -> RgbdFrame | None:
        """Return the newest frame; None when there is none yet, none in time, or none left.

        Raises:
            LinkError: the source cannot deliver frames.
        """
        ...

    def close(self) -> None:
        """Release the source."""
        ...
