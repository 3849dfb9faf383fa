"""The bridge process: the machine as the ROS 2 node ``/timberhand``.

``python -m ros2 --profile palms_471 --report-port 24702 --controller 127.0.0.1:24701 --key-file /etc/timberhand/key``

Publishes ``/joint_states``, ``/tf``, ``/tf_static`` and ``/diagnostics``.  With ``--controller`` it also takes goals of
``control_msgs/FollowJointTrajectory`` under ``/crane_controller/follow_joint_trajectory`` and sends setpoints, so it
stands in the planner's place: start one of the two.  ``python -m ros2.camera`` publishes a camera's pictures.

The wire is that of Cyclone DDS: topics reach every DDS implementation of ROS 2, the action needs clients with
``RMW_IMPLEMENTATION=rmw_cyclonedds_cpp``.  Without ``--interface`` only this computer is reached.

Events on stdout, JSON lines: ``ready``, ``goal``, ``ended`` (its status, error code and reason).  SIGTERM and SIGINT
stop the crane smoothly first.  Exit codes: 0 ended by SIGTERM, 2 usage, 3 configuration, 4 port or domain, 130 SIGINT.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Final

from autonomy.motion.setpoint_stream import SetpointStream
from autonomy.process.command_line import emit
from autonomy.process.controller_link import ControllerLink
from can_dbc.messages.envelope import read_key
from can_dbc.messages.udp_address import local_address_argument
from host.exit_codes import ExitCode
from machine.loading.profile_file import ProfileError, load_profile, profile_hash
from ros2.bridge import Bridge, run
from ros2.execution.execution import TrajectoryExecution
from ros2.process import add_node_options, catch_signals, complain, exit_code, open_node
from runtime.errors import ConfigError, LinkError

NAME: Final = "timberhand"
_FEEDBACK_INDEX: Final = {"jazzy": False, "kilted": True, "lyrical": True}
"""Whether the action's feedback of a distribution has an index: control_msgs 6.3 added it."""


def arguments(argv: list[str]) -> argparse.Namespace:
    """Parse the command line; end the process with code 2 when it is wrong."""
    parser = argparse.ArgumentParser(prog="python -m ros2", description="The machine as a ROS 2 node.")
    parser.add_argument("--profile", default="palms_471", help="shipped name or TOML file of the machine")
    parser.add_argument("--report-port", type=int, required=True, help="local UDP port for state reports")
    parser.add_argument(
        "--controller",
        type=local_address_argument,
        help="HOST:PORT that accepts setpoints; without it no goals are taken",
    )
    parser.add_argument("--lease-ms", type=int, default=200, help="validity of a setpoint")
    parser.add_argument("--key-file", type=Path, help="file with the key that authenticates datagrams")
    parser.add_argument(
        "--distribution", choices=_FEEDBACK_INDEX, default="lyrical", help="ROS 2 release of the action's clients"
    )
    add_node_options(parser)
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    """Run the bridge; returns the exit code."""
    options = arguments(sys.argv[1:] if argv is None else argv)
    signals = catch_signals()
    try:
        profile = load_profile(options.profile)
        key = None if options.key_file is None else read_key(options.key_file)
    except (ProfileError, ConfigError) as error:
        return complain(str(error))
    if not 0 < options.lease_ms <= profile.timeouts.lease_max_ms:
        return complain(f"--lease-ms {options.lease_ms}: {profile.name} allows 1..{profile.timeouts.lease_max_ms}")
    number = profile_hash(profile)
    try:
        link = ControllerLink(options.controller, options.report_port, number, key)
    except (OSError, OverflowError) as error:
        return complain(f"UDP port {options.report_port} cannot be opened ({error}); choose another one", ExitCode.BUS)
    try:
        node = open_node(NAME, options)
        stream = SetpointStream(number, options.lease_ms * 1_000_000, key)
        execution = None if options.controller is None else TrajectoryExecution(profile, stream)
        bridge = Bridge(profile, link, node, execution, _FEEDBACK_INDEX[options.distribution], emit)
        emit("ready", domain=options.domain, goals=execution is not None)
        run(bridge, link, signals)
    except LinkError as error:
        return complain(str(error), ExitCode.BUS)
    finally:
        link.close()
    if link.foreign:
        return complain("the controller runs another profile than this bridge; start both with the same one")
    return exit_code(signals)


if __name__ == "__main__":
    sys.exit(main())
