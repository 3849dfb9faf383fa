"""Real runs in the vcan lab on this computer, and its errors where it cannot run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from host.vcan_lab import uml
from host.vcan_lab.choose import survey
from tests.live.host.lab_runs import LAB, REQUEST, ROOT, TIMEOUT_S, Run, environment, require_lab


def test_status_streams_environment_and_interfaces(lab: Run) -> None:
    """One run: exit status, both streams byte for byte, empty stdin, the lab's marks, loopback UDP."""
    script = """if True:
        import os, socket, sys
        sys.stdout.buffer.write(bytes(range(256)) * 1000 + os.environ["BIG"].encode())
        sys.stderr.buffer.write(bytes(range(255, -1, -1)) * 300)
        assert os.environ["TIMBERHAND_LAB"] in ("uml", "native"), "mark"
        assert sys.stdin.buffer.read() == b"", "stdin"
        udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        udp.bind(("127.0.0.1", 0))
        udp.sendto(b"datagram", udp.getsockname())
        assert udp.recv(99) == b"datagram"
        names = {name for _, name in socket.if_nameindex()}
        sys.exit(77 if {"lo", "vcan0", "vcan1", "crane0"} <= names else 1)
    """
    big = "ä" * 30_000
    done = lab("--link", "crane0", "--", sys.executable, "-c", script, BIG=big)
    assert done.stderr == bytes(range(255, -1, -1)) * 300
    assert done.stdout == bytes(range(256)) * 1000 + big.encode()
    assert done.returncode == 77


def test_candump_sees_a_frame_from_a_python_socket(lab: Run) -> None:
    if not any(Path(folder, "candump").exists() for folder in os.get_exec_path()):
        pytest.skip("candump is missing (apt-get install can-utils)")
    script = """if True:
        import subprocess
        from can_dbc.bus.factory import open_bus
        dump = subprocess.Popen(["candump", "-n", "1", "vcan0"], stdout=subprocess.PIPE)
        with open_bus("socketcan:vcan0") as bus:
            while dump.poll() is None:
                bus.send(0x210, bytes.fromhex("0123456789ABCDEF"))
        print(*dump.stdout.read().decode().split(), end="")
    """
    done = lab("--timeout", "20", "--", sys.executable, "-c", script)
    assert done.stdout.decode() == "vcan0 210 [8] 01 23 45 67 89 AB CD EF", done.stderr


def test_files_written_inside_appear_on_the_host(lab: Run, tmp_path: Path) -> None:
    """Working directory, temporary directory: with a space and a letter beyond ASCII; two labs at once."""
    odd = tmp_path / "an odd földer"
    odd.mkdir()
    script = (
        'echo "$TIMBERHAND_LAB" > log.txt; dd if=/dev/zero of=big bs=1000 count=3000 2>/dev/null; mktemp -p "$TMPDIR"'
    )
    beside = subprocess.Popen(
        [*LAB, "--", "sh", "-c", "echo beside > beside.txt; ip -brief link"],
        cwd=odd,
        env=environment(),
        stdout=subprocess.PIPE,
    )
    done = lab("--", "sh", "-c", script, cwd=odd, TMPDIR=str(odd))
    assert b"vcan1" in beside.communicate(timeout=TIMEOUT_S)[0]
    made = Path(os.fsdecode(done.stdout.strip()))
    assert done.returncode == beside.returncode == 0
    assert sorted(odd.iterdir()) == sorted([odd / "log.txt", odd / "big", odd / "beside.txt", made])
    assert (odd / "log.txt").read_text().strip() in ("uml", "native")
    assert (odd / "big").read_bytes() == bytes(3_000_000)


def test_the_shim_is_harmless_where_it_is_not_needed(lab: Run, tmp_path: Path) -> None:
    if require_lab() != "uml" or not any(Path(folder, "cc").exists() for folder in os.get_exec_path()):
        pytest.skip("needs user-mode Linux and a C compiler")
    wrapper = (
        "import sys; from host.vcan_lab import uml; uml.needed = lambda text: True; "
        "import typer; from host.vcan_lab.__main__ import CONTEXT, vcan; "
        "app = typer.Typer(); app.command(context_settings=CONTEXT)(vcan); app()"
    )
    cache = tmp_path / "a cache: odd"
    done = subprocess.run(
        [sys.executable, "-c", wrapper, sys.executable, "-c", "print(sum(i * 0.5 for i in range(1000)))"],
        cwd=ROOT,
        env=environment(XDG_CACHE_HOME=str(cache)),
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, b"249750.0\n"), done.stderr
    assert [path.name for path in (cache / "timberhand").iterdir()] == ["xstate_shim.so"]


def test_check_prints_the_method_and_the_reason() -> None:
    done = subprocess.run([*LAB, "--check", "--json"], cwd=ROOT, env=environment(), capture_output=True, check=False)
    found = json.loads(done.stdout)
    assert set(found) - {"code"} == {"way", "why", "kernel", "links"}
    assert ("code" in found) == (found["way"] is None)
    assert done.returncode == (4 if found["way"] is None else 0)


def test_without_kernel_support_and_without_the_package_the_exit_status_is_4(tmp_path: Path) -> None:
    if survey(REQUEST).can_fault is None:
        pytest.skip("this machine's kernel has CAN")
    done = subprocess.run(
        [*LAB, "--", "true"], cwd=ROOT, env=environment(PATH=str(tmp_path)), capture_output=True, check=False
    )
    assert (done.returncode, done.stdout) == (4, b"")
    assert done.stderr.decode().count("\n") == 1
    assert "[lab.no-uml]" in done.stderr.decode()


def test_without_the_own_kernel_simulated_time_is_refused_in_one_sentence(tmp_path: Path) -> None:
    done = subprocess.run(
        [*LAB, "--time-travel", "--", "true"],
        cwd=ROOT,
        env=environment(XDG_CACHE_HOME=str(tmp_path)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (4, "")
    assert done.stderr.count("\n") == 1 and "[lab.no-lab-kernel]" in done.stderr


def test_an_hour_of_simulated_time_is_short_and_reproducible() -> None:
    if uml.find(uml.user_cache()) is None:
        pytest.skip(uml.MISSING)
    script = "import time; print(time.monotonic_ns()); time.sleep(3600); print(time.monotonic_ns() // 1000_000)"
    runs = [
        subprocess.run(
            [*LAB, "--time-travel", "--", sys.executable, "-B", "-c", script],
            cwd=ROOT,
            env=environment(),
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=True,
        ).stdout.split()
        for _ in range(2)
    ]
    assert runs[0] == runs[1]
    assert 3_600_000 <= int(runs[0][1]) - int(runs[0][0]) // 1_000_000 <= 3_600_001


def test_no_command_is_a_usage_error() -> None:
    done = subprocess.run(LAB, cwd=ROOT, env=environment(), capture_output=True, check=False)
    assert done.returncode == 2


def test_the_live_bus_tests_pass_in_the_lab(lab: Run) -> None:
    """What is in tests/live/vcan, what is said of SocketCAN alone, and the contract of all buses, it among them."""
    way = require_lab()
    with TemporaryDirectory(prefix="lab") as short:  # sockets' paths are limited to 107 bytes, and tmp_path is deep
        done = lab(
            "--timeout",
            "80",
            "--root",
            "--",
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-p",
            "no:cacheprovider",
            f"--basetemp={short}/inside",
            "tests/live/vcan",
            "tests/live/hil/test_bus_contract.py",
            "tests/live/hil/test_kernel_bus.py",
            "-k",
            "vcan or socketcan or kernel or link",
        )
    report = done.stdout.decode()
    assert done.returncode == 0, report[-30_000:] + done.stderr.decode()
    if way == "uml":  # root, FIFO and every interface are there: nothing but foreign tools may be missing
        skips = [line for line in report.splitlines() if line.startswith("SKIPPED")]
        assert all("apt-get install can-utils" in line for line in skips), report
