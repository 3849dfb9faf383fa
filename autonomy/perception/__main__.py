"""The log detector as a process: pictures of a camera in, log lists out.

``python -m autonomy.perception --profile palms_471 --camera stick --frames 127.0.0.1:47004 --port 47003``

The process answers requests for logs (``autonomy.perception.log_list.datagrams``) over UDP on the loopback interface.
Each request with joints triggers a detection; as long as there is no new result, there is no reply.  A request without
joints, as from a page that only displays logs, gets the last list.  ``--frames`` is the address of a server of frames
(``can_dbc.messages.rgbd``), ``zed`` for a Stereolabs camera on this computer, or a folder of frames.

JSON lines on stdout: ``ready`` with the port, ``trouble`` with its reason.  SIGTERM and SIGINT end the process.
Exit codes: 0 ended, 2 usage, 3 profile, camera or weights, 4 port.
"""

from __future__ import annotations

import argparse
import os
import select
import signal
import socket
import sys
import time
from pathlib import Path
from typing import Final

import msgspec

from autonomy.networks.weights import WeightsError
from autonomy.perception.log_detector import LogDetector
from autonomy.perception.log_list.datagrams import LogListError, decode_request, encode_error, encode_logs
from autonomy.perception.segmentation.log_segmenter import LogSegmenter
from autonomy.perception.sources.camera_source import CameraSource, SourceError
from machine.loading.profile_file import ProfileError, load_profile
from machine.profile import Profile
from runtime.allocator import keep_memory

EXIT_OK, EXIT_CONFIGURATION, EXIT_PORT = 0, 3, 4
FRAME_TIMEOUT_S: Final = 0.5
POLL_S: Final = 0.2
MAX_REQUEST_BYTES: Final = 2048


def open_source(address: str, camera: str, profile: Profile) -> CameraSource:
    """The source that ``--frames`` names.

    Raises:
        SourceError: it cannot be opened.
    """
    if address == "zed":
        from autonomy.perception.sources.zed import ZedCamera

        return ZedCamera(camera)
    if os.path.isdir(address):
        from autonomy.perception.sources.frame_folder import FrameFolder

        return FrameFolder(Path(address))
    from autonomy.perception.sources.stream import StreamCamera

    return StreamCamera(address, camera, FRAME_TIMEOUT_S)


def serve(detector: LogDetector, link: socket.socket, signals: list[int]) -> None:
    """Reply to requests until a signal arrives."""
    reported = ""
    while not signals:
        if not select.select([link], [], [], POLL_S)[0]:
            continue
        data, sender = link.recvfrom(MAX_REQUEST_BYTES)
        try:
            q = decode_request(data)
        except LogListError as error:
            link.sendto(encode_error(str(error)), sender)
            continue
        has_joints = any(value == value for value in q)
        logs = detector.detect(q, time.monotonic_ns()) if has_joints else detector.logs
        if logs is not None:
            link.sendto(encode_logs(logs), sender)
        if detector.problem and detector.problem != reported:
            write_line(event="trouble", reason=detector.problem)
        reported = detector.problem


def write_line(**fields: object) -> None:
    """Write one JSON line to stdout."""
    sys.stdout.write(msgspec.json.encode(fields).decode() + "\n")
    sys.stdout.flush()


def main(argv: list[str] | None = None) -> int:
    """Run until a signal arrives; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m autonomy.perception", description="Detect logs in the pictures of a camera."
    )
    parser.add_argument("--profile", default="palms_471", help="shipped name or TOML file of the machine")
    parser.add_argument("--camera", required=True, help="name of the camera in the profile")
    parser.add_argument("--frames", required=True, metavar="HOST:PORT|zed|FOLDER", help="source of the pictures")
    parser.add_argument("--port", type=int, default=0, help="UDP port of the log list (default: any free port)")
    parser.add_argument("--variant", choices=("rgbd", "depth"), default="rgbd", help="input of the network")
    parser.add_argument("--weights", type=Path, help="weights of the network (default: the shipped weights)")
    options = parser.parse_args(argv)
    keep_memory()
    try:
        profile = load_profile(options.profile)
        if options.camera not in profile.cameras:
            known = ", ".join(profile.cameras) or "none"
            return _fail(f"{profile.name} has no camera {options.camera!r}; it has: {known}")
        segmenter = LogSegmenter(options.variant, options.weights)
        source = open_source(options.frames, options.camera, profile)
    except (ProfileError, WeightsError, SourceError) as error:
        return _fail(str(error))
    signals: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: signals.append(number))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        try:
            link.bind(("127.0.0.1", options.port))
        except (OSError, OverflowError) as error:
            return _fail(f"UDP port {options.port} cannot be opened ({error}); choose another port", EXIT_PORT)
        write_line(ready=link.getsockname()[1], camera=options.camera)
        try:
            serve(LogDetector(profile, options.camera, source, segmenter.segment), link, signals)
        finally:
            source.close()
    return EXIT_OK


def _fail(sentence: str, code: int = EXIT_CONFIGURATION) -> int:
    sys.stderr.write(f"{sentence}\n")
    return code


if __name__ == "__main__":
    sys.exit(main())
