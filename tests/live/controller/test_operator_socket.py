"""Authority: only who may write to the operator's socket arms; STOP is heard from anyone, the operator's first."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from controller.requests.operator_socket import OperatorSocket

NOBODY = 65534
SEND_AS_NOBODY = (
    "import os, socket, sys\n"
    "os.setgroups([])\n"
    "os.setgid(65534)\n"
    "os.setuid(65534)\n"
    "socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM).sendto(b'hello', sys.argv[1])\n"
)


@pytest.fixture
def path():
    """A place that any user may reach, as pytest's own are not."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name, "operator")


def received(operator):
    commands = []
    operator.receive(commands)
    return commands


@pytest.mark.skipif(os.getuid() != 0, reason="only root can send as another user")
def test_another_user_cannot_send(path):
    before = os.umask(0)  # the socket's own mode decides
    operator = OperatorSocket(path)
    os.umask(before)
    done = subprocess.run([sys.executable, "-c", SEND_AS_NOBODY, path], capture_output=True, text=True)
    assert "PermissionError" in done.stderr and received(operator) == []
    os.chown(path, -1, NOBODY)  # a member of the socket's group can
    subprocess.run([sys.executable, "-c", SEND_AS_NOBODY, path], check=True)
    assert received(operator) == [b"hello"]
    operator.close()
