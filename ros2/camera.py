"""A camera as the ROS 2 node ``/timberhand_CAMERA``, in a process of its own, so that pictures delay no setpoint.

``python -m ros2.camera --profile palms_471 --camera stick --frames 127.0.0.1:47004``

Publishes ``/CAMERA/image_rect_color``, ``/CAMERA/depth/image_rect`` and the ``camera_info`` beside each, best effort.
``--frames`` is a server of frames (`can_dbc.messages.rgbd`): the plant, or a camera's process.  It is asked for a
picture only while somebody subscribes.  The frame of the pictures is in ``/tf``, from the bridge (`ros2.__main__`).

JSON lines on stdout: ``ready``, and ``trouble`` with its reason when pictures cease.  Exit codes: 0 ended by SIGTERM,
2 usage, 3 profile or camera, 4 domain, 130 SIGINT.
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import Final

from autonomy.perception.sources.stream import StreamCamera
from autonomy.process.command_line import emit
from host.exit_codes import ExitCode
from machine.loading.profile_file import ProfileError, load_profile
from ros2.interfaces.sensor import CameraInfo, Image
from ros2.process import add_node_options, catch_signals, complain, exit_code, open_node
from ros2.report import camera_info, colour_image, depth_image
from ros2.wire.node import Node, send
from ros2.wire.qos import sensor_data
from runtime.errors import LinkError

FRAME_TIMEOUT_S: Final = 0.5
POLL_S: Final = 0.1
MAX_RATE_HZ: Final = 60.0


class CameraNode:
    """The topics of one camera."""

    def __init__(self, node: Node, camera: str, source: StreamCamera) -> None:
        self._node = node  # its endpoints end with it
        self._source = source
        self._colour = node.publisher(f"{camera}/image_rect_color", Image, sensor_data())
        self._colour_info = node.publisher(f"{camera}/camera_info", CameraInfo, sensor_data())
        self._depth = node.publisher(f"{camera}/depth/image_rect", Image, sensor_data())
        self._depth_info = node.publisher(f"{camera}/depth/camera_info", CameraInfo, sensor_data())
        node.announce()

    @property
    def wanted(self) -> bool:
        """Whether somebody subscribes to a topic of the camera."""
        topics = (self._colour, self._colour_info, self._depth, self._depth_info)
        return any(topic.get_matched_subscriptions() for topic in topics)

    def publish(self) -> str:
        """Get one frame and publish it; returns the reason when there is none, else nothing."""
        frame = self._source.frame()
        if frame is None:
            return self._source.problem
        stamp_ns = self._source.asked_ns + time.time_ns() - time.monotonic_ns()
        info = camera_info(frame, stamp_ns)
        send(self._colour, colour_image(frame, stamp_ns))
        send(self._colour_info, info)
        send(self._depth, depth_image(frame, stamp_ns))
        send(self._depth_info, info)
        return ""


def _run(node: CameraNode, period_s: float, signals: list[int]) -> None:
    """Publish at most every ``period_s`` while somebody wants pictures, until a signal arrives."""
    reported_problem = ""
    while not signals:
        begin_s = time.monotonic()
        if not node.wanted:
            time.sleep(POLL_S)
            continue
        problem = node.publish()
        if problem and problem != reported_problem:
            emit("trouble", reason=problem)
        reported_problem = problem
        time.sleep(max(POLL_S if problem else 0.0, begin_s + period_s - time.monotonic(), 0.0))


def _rate(text: str) -> float:
    try:
        rate_hz = float(text)
    except ValueError:
        rate_hz = 0.0
    if not 0.0 < rate_hz <= MAX_RATE_HZ:
        raise argparse.ArgumentTypeError(f"{text!r} is no rate; write a number above 0 and up to {MAX_RATE_HZ:.0f} Hz")
    return rate_hz


def main(argv: list[str] | None = None) -> int:
    """Publish until a signal arrives; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m ros2.camera", description="A camera as a ROS 2 node.")
    parser.add_argument("--profile", default="palms_471", help="shipped name or TOML file of the machine")
    parser.add_argument("--camera", required=True, help="name of the camera in the profile")
    parser.add_argument("--frames", required=True, metavar="HOST:PORT|unix:PATH", help="server of the pictures")
    parser.add_argument("--rate-hz", type=_rate, default=4.0, help="greatest rate of the pictures")
    add_node_options(parser)
    options = parser.parse_args(argv)
    signals = catch_signals()
    try:
        profile = load_profile(options.profile)
    except ProfileError as error:
        return complain(str(error))
    if options.camera not in profile.cameras:
        known = ", ".join(profile.cameras) or "none"
        return complain(f"{profile.name} has no camera {options.camera!r}; it has: {known}")
    source = StreamCamera(options.frames, options.camera, FRAME_TIMEOUT_S)
    try:
        camera = CameraNode(open_node(f"timberhand_{options.camera}", options), options.camera, source)
        emit("ready", camera=options.camera, domain=options.domain)
        _run(camera, 1.0 / options.rate_hz, signals)
    except LinkError as error:
        return complain(str(error), ExitCode.BUS)
    finally:
        source.close()
    return exit_code(signals)


if __name__ == "__main__":
    sys.exit(main())
