"""The end of runs in the vcan lab, without leftovers."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.live.host.lab_runs import (
    LAB,
    ROOT,
    TIMEOUT_S,
    Run,
    descendants,
    eldest_child,
    environment,
    require_lab,
    wait_until,
)


@pytest.mark.parametrize(
    ("command", "status"),
    [(["sh", "-c", "kill -TERM $$"], 128 + 15), (["no-such-command"], 127), (["/"], 126)],
)
def test_how_a_command_ends(lab: Run, command: list[str], status: int) -> None:
    done = lab("--", *command)
    assert (done.returncode, done.stdout) == (status, b""), done.stderr.decode()
    assert (b"vcan lab: " in done.stderr) == (status < 128)


@pytest.mark.parametrize("deaths", [1, 2])
def test_a_guest_that_dies_before_the_command_boots_once_more(lab: Run, tmp_path: Path, deaths: int) -> None:
    real = shutil.which("linux.uml")
    if real is None:
        pytest.skip("linux.uml is missing (apt-get install user-mode-linux)")
    kernel = tmp_path / "linux.uml"
    boots = tmp_path / "boots"
    kernel.write_text(f"""#!/bin/sh
echo boot >> {boots}
[ $(wc -l < {boots}) -gt {deaths} ] && exec {real} "$@"
echo "a sad end"
""")
    kernel.chmod(0o755)
    done = lab("--kernel", "debian", "--", "echo", "once", PATH=f"{tmp_path}:{os.environ['PATH']}")
    assert b"a sad end" in done.stderr
    assert (done.returncode, done.stdout) == ((0, b"once\n") if deaths == 1 else (4, b""))
    assert len(boots.read_text().split()) == 2


def test_a_command_over_its_time_limit_is_killed(
    lab: Run,
) -> None:
    done = lab("--timeout", "2", "--", "sh", "-c", "trap 'echo told; trap \"\" TERM' TERM; while :; do :; done")
    assert (done.returncode, done.stdout) == (124, b"told\n")


def test_a_closed_reader_ends_the_writer(lab: Run) -> None:
    endless = subprocess.Popen([*LAB, "--", "yes"], cwd=ROOT, env=environment(), stdout=subprocess.PIPE)
    assert endless.stdout and endless.stdout.readline() == b"y\n"
    endless.stdout.close()
    assert endless.wait(TIMEOUT_S) == 128 + signal.SIGPIPE


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_lab_leaves_nothing_behind(number: signal.Signals, tmp_path: Path) -> None:
    """Ctrl-C reaches the command; a killed wrapper takes every process with it; no file is left."""
    way = require_lab()
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    wrapper = subprocess.Popen(
        [*LAB, "--", "sh", "-c", "echo up; while :; do :; done"],
        cwd=ROOT,
        env=environment(TMPDIR=str(temporary)),
        stdout=subprocess.PIPE,
    )
    assert wrapper.stdout and wrapper.stdout.readline() == b"up\n"
    below = descendants(wrapper.pid)
    assert len(below) >= (4 if way == "uml" else 2)
    wrapper.send_signal(number)
    assert wrapper.wait(TIMEOUT_S) == (130 if number == signal.SIGINT else -signal.SIGKILL)
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in below), f"left behind: {below}")
    assert list(temporary.iterdir()) == []


def test_a_killed_user_mode_kernel_is_reported(tmp_path: Path) -> None:
    if require_lab() != "uml":
        pytest.skip("this machine's kernel has CAN")
    wrapper = subprocess.Popen(
        [*LAB, "--", "sh", "-c", "echo up; while :; do :; done"],
        cwd=ROOT,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert wrapper.stdout and wrapper.stdout.readline() == b"up\n"
    below = descendants(wrapper.pid)
    kernel = eldest_child(eldest_child(wrapper.pid))  # of the keeper, which is the wrapper's
    os.kill(kernel, signal.SIGKILL)
    wrapper.communicate(timeout=TIMEOUT_S)
    assert wrapper.returncode == 4
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in below), f"left behind: {below}")


def test_a_lab_ends_when_its_caller_is_killed(tmp_path: Path) -> None:
    require_lab()
    out = tmp_path / "out"
    lab = shlex.join([*LAB, "--", "sh", "-c", "echo up; while :; do :; done"])
    caller = subprocess.Popen(
        ["sh", "-c", f"{lab} >{out}; true"],
        cwd=ROOT,
        env=environment(),
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),  # a lab goes on under nohup
    )
    wait_until(lambda: out.exists() and out.read_text() == "up\n", "the lab does not start")
    below = descendants(caller.pid)
    caller.kill()
    caller.wait()
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in below), f"left behind: {below}")


def test_a_command_that_ends_at_once_is_reported() -> None:
    """The starting call returns when the command is over: its status must still come to the supervisor."""
    script = (
        "import json, os, socket, subprocess\n"
        "from host.vcan_lab.guest import Host, Supervisor\n"
        "class Slow(subprocess.Popen):\n"
        "    def __init__(self, *a, **k):\n"
        "        super().__init__(*a, **k)\n"
        "        os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT)\n"
        "subprocess.Popen = Slow\n"
        "near, far = socket.socketpair()\n"
        "order = {'argv': ['sh', '-c', 'exit 7'], 'cwd': '/', 'env': dict(os.environ), 'umask': 0o22}\n"
        "Supervisor(Host(far.fileno()), order, {'out': 1, 'err': 2}, None).run()\n"
        "print(near.recv(999).decode())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, env=environment(), capture_output=True, timeout=TIMEOUT_S, check=True
    )
    assert b'{"exit": 7}' in done.stdout


def test_leftover_processes_are_ended_natively_too(tmp_path: Path) -> None:
    """A process that left the command's group and session is still below the lab."""
    script = (
        "import os, sys; from host.vcan_lab.choose import Method; from host.vcan_lab.host import run\n"
        "from host.vcan_lab.spec import Request\n"
        "argv = ('sh', '-c', 'setsid sleep 300 & echo $! > left; sleep 0.5')\n"
        "request = Request(argv=argv, cwd=sys.argv[1], env=dict(os.environ), uid=os.getuid(), gid=os.getgid(),\n"
        "                  groups=tuple(os.getgroups()), umask=0o22)\n"
        "sys.exit(run(request, Method('existing', 'for this test', None)))\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], cwd=ROOT, timeout=TIMEOUT_S)
    assert done.returncode == 0
    left = int((tmp_path / "left").read_text())
    wait_until(lambda: not Path(f"/proc/{left}").exists(), f"process {left} is left behind")
