"""Authority: only who may write to the operator's socket arms; STOP is heard from anyone, the operator's first."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from can_dbc.messages.crane import OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import encode
from can_dbc.messages.envelope import signed
from can_dbc.messages.operator_link import credential_path
from controller.process.operator_socket import OperatorSocket

NOBODY = 65534
BECOME_NOBODY = "import os, socket, sys\nos.setgroups([])\nos.setgid(65534)\nos.setuid(65534)\n"
SEND = "socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM).sendto(bytes.fromhex(sys.argv[2]), sys.argv[1])\n"
READ = "print(open(sys.argv[1], 'rb').read().hex())\n"
ARM = encode(OperatorCommand(1, 2, 3, OperatorAction.ARM))


@pytest.fixture
def path():
    """A place that any user may reach, as pytest's own are not."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name, "operator")


def as_nobody(code, *arguments):
    command = [sys.executable, "-c", BECOME_NOBODY + code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True)


def received(operator):
    commands = []
    operator.receive(commands, [])
    return commands


@pytest.mark.skipif(os.getuid() != 0, reason="only root can send as another user")
def test_another_user_can_neither_send_nor_read_the_credential(path):
    before = os.umask(0)  # the files' own modes decide
    operator = OperatorSocket(path)
    os.umask(before)
    credential = credential_path(path)
    assert "PermissionError" in as_nobody(SEND, path, ARM.hex()).stderr and received(operator) == []
    assert "PermissionError" in as_nobody(READ, credential).stderr
    os.chown(path, -1, NOBODY)  # a member of the socket's group alone is heard as anyone, of both groups as an operator
    assert as_nobody(SEND, path, ARM.hex()).returncode == 0 and received(operator) == []
    os.chown(credential, -1, NOBODY)
    read = as_nobody(READ, credential).stdout.strip()
    assert as_nobody(SEND, path, signed(ARM, bytes.fromhex(read)).hex()).returncode == 0
    assert received(operator) == [ARM]
    operator.close()
