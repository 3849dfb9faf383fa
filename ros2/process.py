"""What the bridge's two processes share: options of the node, signals, and complaints."""

from __future__ import annotations

import argparse
import os
import signal
import sys

from host.exit_codes import ExitCode
from ros2.wire.node import LOOPBACK, MAX_DOMAIN, Node


def domain(text: str) -> int:
    """Parse a ROS 2 domain as a command line writes it."""
    if not text.isdecimal() or int(text) > MAX_DOMAIN:
        raise argparse.ArgumentTypeError(f"{text!r} is no ROS 2 domain; write a number from 0 to {MAX_DOMAIN}")
    return int(text)


def add_node_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a process that is a ROS 2 node."""
    parser.add_argument(
        "--domain",
        type=domain,
        default=os.environ.get("ROS_DOMAIN_ID") or "0",
        help="ROS 2 domain (default: ROS_DOMAIN_ID, or 0)",
    )
    parser.add_argument(
        "--interface",
        default=LOOPBACK,
        metavar="ADDRESS",
        help="address of the network interface to use (default: this computer only)",
    )


def open_node(name: str, options: argparse.Namespace) -> Node:
    """Open the node of a process; warn when others can reach it.  Raises LinkError."""
    node = Node(name, options.domain, options.interface)
    if options.interface != LOOPBACK:
        sys.stderr.write(
            f"ros2: warning: ROS 2 has no authentication here; whoever reaches {options.interface} can read, and send "
            "goals if this node takes them\n"
        )
    return node


def catch_signals() -> list[int]:
    """Return a list in which SIGINT and SIGTERM appear when they arrive."""
    signals: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: signals.append(number))
    return signals


def complain(sentence: str, code: ExitCode = ExitCode.CONFIGURATION) -> int:
    """Write why the process ends; returns its exit code."""
    sys.stderr.write(f"ros2: {sentence}\n")
    return code


def exit_code(signals: list[int]) -> int:
    """Return the exit code after these signals."""
    return ExitCode.INTERRUPTED if signal.SIGINT in signals else ExitCode.OK
