"""What OpenVINO must not do to a process: open a connection, or take its signals."""

from __future__ import annotations

import subprocess
import sys


def test_openvino_opens_no_connection() -> None:
    program = (
        "import socket, sys\n"
        "def never(*a, **k): raise SystemExit('a socket was opened')\n"
        "socket.socket.connect = socket.create_connection = socket.getaddrinfo = never\n"
        "from autonomy.networks import _core\n"
        "_core()\n"
        "from openvino.tools.ovc import telemetry_utils\n"
        "print(telemetry_utils.tm.__name__, 'torch' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["openvino.tools.ovc.telemetry_stub", "False"]


def test_signals_arrive_after_two_networks_are_gone() -> None:
    """A process that loads one network after another must still end properly on Ctrl-C."""
    program = (
        "import signal\n"
        "from autonomy.networks import SHIPPED, OpenVinoNet, load\n"
        "from autonomy.perception.segmentation.segment_merging import QUALITY_NETWORK as QUALITY\n"
        "weights = load(SHIPPED / 'segment_quality.onnx', QUALITY)\n"
        "nets = [OpenVinoNet(weights, (1, QUALITY.channels, 1, n)) for n in (2, 3)]\n"
        "while nets: nets.pop(0)\n"
        "received = []\n"
        "signal.signal(signal.SIGINT, lambda number, _: received.append(number))\n"
        "signal.raise_signal(signal.SIGINT)\n"
        "print(received)\n"
    )
    done = subprocess.run(
        [sys.executable, "-X", "faulthandler", "-c", program], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "[2]\n")
