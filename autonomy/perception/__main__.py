"""The log detector as a process: pictures of a camera in, log lists out.

``python -m autonomy.perception --profile palms_471 --camera stick --frames 127.0.0.1:47004 --port 47003``

With ``--driving`` the camera looks ahead of a machine that drives (`autonomy.perception.driving_requests`).

The process answers requests for logs (``autonomy.perception.log_list``) over UDP on the loopback interface.
A request with joints triggers a detection, of several that wait the newest one; as long as there is no new result,
there is no reply.  A request without joints, as from a page that only displays logs, gets the last list, and a request
for a picture the last measured one (``can_dbc.messages.picture``).  ``--frames`` is the address of a server of frames
(``can_dbc.messages.rgbd``), ``zed`` for a Stereolabs camera on this computer, or a folder of frames.

JSON lines on stdout: ``ready`` with the port, ``trouble`` with its reason.  systemd is told that it is ready, how many
lists it makes, and ten times a second that it lives (`runtime.notifier`): a camera that hangs ends that.  SIGTERM and
SIGINT end the process.  Exit codes: 0 ended, 2 usage, 3 profile, name of the camera, frames or weights, 4 port, or a
camera that cannot be opened now.
"""

from __future__ import annotations

import argparse
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final, Protocol

import msgspec
import numpy as np

from autonomy.perception.driving_log_detector import (
    CylinderLocalizer,
    DrivingLogDetector,
    LogLocalizer,
    PaperBLocalizer,
    Segmentation,
)
from autonomy.perception.driving_requests import DrivingRequests, StandingRequests, asked_ns
from autonomy.perception.log_detector import LogDetector
from autonomy.perception.papers import BoxSegmenter
from autonomy.perception.segmentation.log_segmenter import LogSegmenter
from autonomy.perception.segmentation.mask_segmenter import MaskSegmenter
from autonomy.perception.shown_picture import MeasuredPicture, NewestPicture
from autonomy.perception.sources.camera_source import CameraSource
from autonomy.perception.tracking.log_filter import SURVEYED_BY_GNSS
from machine.geometry.optics import Intrinsics
from machine.loading.profile_file import ProfileError, load_profile
from machine.profile import Profile
from runtime.errors import InputRefused, LinkError
from runtime.memory import keep_memory
from runtime.notifier import Notifier

EXIT_OK, EXIT_CONFIGURATION, EXIT_PORT = 0, 3, 4
COMES_BACK: Final = "camera-source.not-opened"
"""Code of a camera that is not there now."""
POLL_S: Final = 0.1
FRAME_TIMEOUT_S: Final = 0.5
FRAME_PX: Final = 608
"""Size of paper B's pictures."""
PAPER_B: Final = "paper-b"
"""Boxes, and the depth at their middles: `PaperBLocalizer`."""
LOCALIZERS: Final[dict[str, Callable[[Profile], LogLocalizer]]] = {
    "ours": lambda profile: CylinderLocalizer(profile, SURVEYED_BY_GNSS),
    PAPER_B: lambda profile: PaperBLocalizer(),
}
"""Methods with a surveyed camera and a position from the receiver."""


def open_source(address: str, camera: str, profile: Profile) -> CameraSource:
    """Open the source that ``--frames`` names.

    Raises:
        LinkError: it cannot be opened.
    """
    if address == "zed":
        from autonomy.perception.sources.zed import ZedCamera

        return ZedCamera(camera)
    if os.path.isdir(address):
        from autonomy.perception.sources.frame_folder import FrameFolder

        return FrameFolder(Path(address))
    from autonomy.perception.sources.stream import StreamCamera

    return StreamCamera(address, camera, FRAME_TIMEOUT_S)


def warm_up(segmenter: LogSegmenter | MaskSegmenter) -> None:
    """Segment a grey picture, so that the network is compiled before the machine drives."""
    grey = np.full((FRAME_PX, FRAME_PX, 3), 96, np.uint8)
    pinhole = Intrinsics(FRAME_PX, FRAME_PX, FRAME_PX, FRAME_PX, 0.5 * FRAME_PX, 0.5 * FRAME_PX)
    segmenter.segment_picture(grey, np.full((FRAME_PX, FRAME_PX), 5.0, np.float32), pinhole)


def write_trouble(reason: str) -> None:
    """Say why there are no logs."""
    write_line(event="trouble", reason=reason)


def write_line(**fields: object) -> None:
    """Write one JSON line to stdout."""
    sys.stdout.write(msgspec.json.encode(fields).decode() + "\n")
    sys.stdout.flush()


class Requests(Protocol):
    """`StandingRequests` or `DrivingRequests`."""

    lists: int

    @property
    def log_count(self) -> int:
        """Number of logs in the last list."""

    @property
    def problem(self) -> str:
        """Why there is no list now."""

    def answer_waiting(self) -> None:
        """Answer the requests that wait."""


class StatusText:
    """The status for systemd and ``timberhand service status``: lists per second since the last call, or trouble."""

    def __init__(self, camera: str, requests: Requests, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._camera, self._requests, self._clock_ns = camera, requests, now_ns
        self._lists, self._begin_ns = 0, now_ns()

    def __call__(self) -> str:
        """Return the status in one line."""
        requests, now_ns = self._requests, self._clock_ns()
        rate_hz = 1e9 * (requests.lists - self._lists) / max(now_ns - self._begin_ns, 1)
        self._lists, self._begin_ns = requests.lists, now_ns
        if requests.problem:
            return f"No logs: {requests.problem}"
        if not requests.lists:
            return f"Camera {self._camera} waits for a planner."
        return f"Camera {self._camera}: {requests.log_count} logs, {rate_hz:.1f} lists per second."


def serve(link: socket.socket, requests: Requests, notifier: Notifier, signals: list[int]) -> None:
    """Reply until a signal arrives."""
    while not signals:
        notifier.tick_done(time.monotonic_ns(), True)
        if select.select([link], [], [], POLL_S)[0]:
            requests.answer_waiting()
    notifier.stopping()


MASKS: Final = {"masks": "rgbd", "masks-depth": "depth", "masks-colour": "colour"}
"""Variants of the mask network by their mode: for looks that the drawn pictures do not have."""


def command_line() -> argparse.ArgumentParser:
    """Define the options."""
    parser = argparse.ArgumentParser(
        prog="python -m autonomy.perception", description="Detect logs in the pictures of a camera."
    )
    parser.add_argument("--profile", default="palms_471", help="shipped name or TOML file of the machine")
    parser.add_argument("--camera", help="name of the camera in the profile (default: its first one)")
    parser.add_argument("--frames", required=True, metavar="HOST:PORT|zed|FOLDER", help="source of the pictures")
    parser.add_argument("--port", type=int, default=0, help="UDP port of the log list (default: any free port)")
    parser.add_argument("--variant", choices=("rgbd", "depth", *MASKS), default="rgbd", help="network and its input")
    parser.add_argument("--driving", action="store_true", help="the machine drives, and its planner says where it is")
    parser.add_argument(
        "--localizer", choices=LOCALIZERS, default="ours", help="with --driving: ours, or paper B's boxes"
    )
    parser.add_argument("--weights", type=Path, help="weights of the network (default: the shipped weights)")
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run until a signal arrives and return the exit code."""
    options = command_line().parse_args(argv)
    keep_memory()
    try:
        profile = load_profile(options.profile)
        options.camera = options.camera or next(iter(profile.cameras), "")
        if options.camera not in profile.cameras:
            known = ", ".join(profile.cameras) or "none"
            return _fail(f"{profile.name} has no camera {options.camera!r}; it has: {known}")
        segmenter: LogSegmenter | MaskSegmenter | BoxSegmenter
        if options.driving and options.localizer == PAPER_B:
            segmenter = BoxSegmenter()
        elif options.variant in MASKS:
            segmenter = MaskSegmenter(MASKS[options.variant], options.weights)
        else:
            segmenter = LogSegmenter(options.variant, options.weights)
        source = open_source(options.frames, options.camera, profile)
    except (ProfileError, InputRefused, LinkError) as error:
        return _fail(str(error), EXIT_PORT if error.code == COMES_BACK else EXIT_CONFIGURATION)
    if not isinstance(segmenter, BoxSegmenter):
        warm_up(segmenter)
    segment: Segmentation = segmenter.segment
    signals: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: signals.append(number))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        try:
            link.bind(("127.0.0.1", options.port))
        except (OSError, OverflowError) as error:
            return _fail(f"UDP port {options.port} cannot be opened ({error}); choose another port", EXIT_PORT)
        write_line(ready=link.getsockname()[1], camera=options.camera)
        pictures = NewestPicture(options.camera)

        def measured(picture: MeasuredPicture) -> None:
            pictures.keep(picture, time.monotonic_ns())

        try:
            requests: Requests
            if options.driving:
                localizer = LOCALIZERS[options.localizer](profile)
                detector = DrivingLogDetector(profile, options.camera, source, segment, localizer, measured)
                requests = DrivingRequests(detector, link, partial(asked_ns, source), write_trouble, pictures)
            else:
                still = LogDetector(profile, options.camera, source, segment, measured)
                requests = StandingRequests(still, link, write_trouble, pictures)
            serve(link, requests, Notifier(StatusText(options.camera, requests)), signals)
        finally:
            source.close()
    return EXIT_OK


def _fail(sentence: str, code: int = EXIT_CONFIGURATION) -> int:
    sys.stderr.write(f"{sentence}\n")
    return code


if __name__ == "__main__":
    sys.exit(main())
