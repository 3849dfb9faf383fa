"""The eyes as a process: pictures of a camera in, the log list out.

``python -m autonomy.perception --profile palms_471 --camera stick --frames 127.0.0.1:47004 --port 47003``

Answers the planner's questions (``autonomy.perception.log_list.observation``) over UDP on the loopback interface: each is a look through the
camera, and as long as that has nothing new to say there is no answer.  A question without joints, as of a page that
only shows what is known, gets the last list.  ``--frames`` is where the camera's pictures are served
(``can_dbc.messages.rgbd``), ``zed`` a Stereolabs camera on this computer, or the folder of a recording.

JSON lines on stdout: ``ready`` with the port, ``trouble`` with its reason.  SIGTERM and SIGINT end it.
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

from autonomy.networks.weights import WeightsRefused
from autonomy.perception.log_detector import LogDetector
from autonomy.perception.log_list.datagrams import LogListError, decode_request, encode_error, encode_logs
from autonomy.perception.segmentation.log_segmenter import LogSegmenter
from autonomy.perception.sources.camera_source import CameraSource, SourceError
from machine.loading.profile_file import ProfileError, load_profile
from machine.profile import Profile
from runtime.allocator import keep_memory

FINE, CONFIGURATION, BUSY = 0, 3, 4
PATIENCE_S: Final = 0.5
"""How long a picture may take to come."""


def opened(where: str, camera: str, profile: Profile) -> CameraSource:
    """The source that ``--frames`` names; raises ``SourceError``."""
    if where == "zed":
        from autonomy.perception.sources.zed import ZedCamera

        return ZedCamera(camera)
    if os.path.isdir(where):
        from autonomy.perception.sources.frame_folder import Recording

        return Recording(Path(where))
    from autonomy.perception.sources.stream import StreamCamera

    return StreamCamera(where, camera, PATIENCE_S)


def serve(eyes: LogDetector, link: socket.socket, ended: list[int]) -> None:
    """Answer until a signal comes."""
    told = ""
    while not ended:
        if not select.select([link], [], [], 0.2)[0]:
            continue
        data, sender = link.recvfrom(2048)
        try:
            q = decode_request(data)
        except LogListError as error:
            link.sendto(encode_error(str(error)), sender)
            continue
        logs = eyes.detect(q, time.monotonic_ns()) if any(value == value for value in q) else eyes.logs
        if logs is not None:
            link.sendto(encode_logs(logs), sender)
        if eyes.trouble and eyes.trouble != told:
            say(event="trouble", reason=eyes.trouble)
        told = eyes.trouble


def say(**what: object) -> None:
    """One JSON line on stdout."""
    sys.stdout.write(msgspec.json.encode(what).decode() + "\n")
    sys.stdout.flush()


def main(argv: list[str] | None = None) -> int:
    """Looks until it is ended; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m autonomy.perception", description="Sees logs through a camera.")
    parser.add_argument("--profile", default="palms_471", help="shipped name or TOML file of the machine")
    parser.add_argument("--camera", required=True, help="name of the camera in the profile")
    parser.add_argument("--frames", required=True, metavar="HOST:PORT|zed|FOLDER", help="where its pictures come from")
    parser.add_argument("--port", type=int, default=0, help="UDP port of the log list (default: any free one)")
    parser.add_argument("--variant", choices=("rgbd", "depth"), default="rgbd", help="what the network looks at")
    parser.add_argument("--weights", type=Path, help="weights of the network (default: the shipped ones)")
    options = parser.parse_args(argv)
    keep_memory()
    try:
        profile = load_profile(options.profile)
        if options.camera not in profile.cameras:
            known = ", ".join(profile.cameras) or "none"
            return _complain(f"{profile.name} has no camera {options.camera!r}; it has: {known}")
        finder = LogSegmenter(options.variant, options.weights)
        source = opened(options.frames, options.camera, profile)
    except (ProfileError, WeightsRefused, SourceError) as error:
        return _complain(str(error))
    ended: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: ended.append(number))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        try:
            link.bind(("127.0.0.1", options.port))
        except (OSError, OverflowError) as error:
            return _complain(f"UDP port {options.port} cannot be opened ({error}); choose another one", BUSY)
        say(ready=link.getsockname()[1], camera=options.camera)
        try:
            serve(LogDetector(profile, options.camera, source, finder.segment), link, ended)
        finally:
            source.close()
    return FINE


def _complain(sentence: str, code: int = CONFIGURATION) -> int:
    sys.stderr.write(f"{sentence}\n")
    return code


if __name__ == "__main__":
    sys.exit(main())
