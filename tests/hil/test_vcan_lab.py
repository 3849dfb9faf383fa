"""The vcan lab: the choice of a way, the texts it builds, and real runs on this machine."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from hil.vcan_lab import shim
from hil.vcan_lab.choose import Machine, choose, survey
from hil.vcan_lab.spec import LabError, Request, kernel_arguments, link_fault, order

ROOT = Path(__file__).parents[2]
LAB = [sys.executable, "-m", "hil.vcan_lab"]
REQUEST = Request(
    argv=("true",), cwd="/", env={"A": "b"}, uid=1000, gid=100, groups=(100, 4), umask=0o22, mem_mb=256
)  # fmt: skip
BARE = Machine(
    can_fault="Address family not supported by protocol",
    existing_fault=None,
    namespace_fault=None,
    kernel="/usr/bin/linux.uml",
    architecture="x86_64",
)
PATIENCE_S = 30.0

Run = Callable[..., subprocess.CompletedProcess[bytes]]


# ------------------------------------------------------------------------------- the choice
def test_a_kernel_with_the_interfaces_up_is_used_as_it_is() -> None:
    assert choose(replace(BARE, can_fault=None)).kind == "existing"


def test_a_kernel_with_vcan_gets_a_namespace() -> None:
    way = choose(replace(BARE, can_fault=None, existing_fault="vcan0: No such device"))
    assert (way.kind, way.kernel) == ("namespace", None)


@pytest.mark.parametrize(
    "machine",
    [BARE, replace(BARE, can_fault=None, existing_fault="vcan0: No such device", namespace_fault="not permitted")],
)
def test_without_vcan_the_user_mode_kernel_is_taken(machine: Machine) -> None:
    way = choose(machine)
    assert (way.kind, way.kernel) == ("uml", "/usr/bin/linux.uml")


def test_without_any_way_one_sentence_names_both_reasons() -> None:
    with pytest.raises(LabError) as refused:
        choose(replace(BARE, kernel=None))
    sentence = str(refused.value)
    assert "no AF_CAN" in sentence
    assert "linux.uml is missing: apt-get install user-mode-linux" in sentence
    assert "\n" not in sentence


def test_the_user_mode_kernel_is_not_promised_to_other_processors() -> None:
    with pytest.raises(LabError, match="x86_64 only, this is aarch64"):
        choose(replace(BARE, architecture="aarch64", kernel=None))


# ------------------------------------------------------------------------------- the texts
def test_the_order_carries_the_caller_and_the_lab() -> None:
    text = order(REQUEST, "uml", new_links=True)
    assert text["user"] == [1000, 100, [100, 4]]
    assert text["links"] == ["vcan0", "vcan1"]
    assert text["env"] == {"A": "b", "TIMBERHAND_LAB": "uml", "XDG_RUNTIME_DIR": "/dev/runtime"}
    assert not text["host_shm"]
    assert order(replace(REQUEST, root=True), "uml", new_links=True)["user"] is None


def test_existing_interfaces_are_not_made_again() -> None:
    assert order(REQUEST, "native", new_links=False)["links"] == []


@pytest.mark.parametrize(
    ("request_", "needed"),
    [
        (replace(REQUEST, cwd="/dev/shm/x"), []),
        (replace(REQUEST, argv=("ls", "/dev/shm")), []),
        (replace(REQUEST, env={"TMPDIR": "/dev/shm/t"}), []),
        (REQUEST, ["/dev/shm/venv"]),
    ],
)
def test_what_lies_in_shared_memory_stays_in_sight(request_: Request, needed: list[str]) -> None:
    assert order(request_, "uml", True, needed)["host_shm"]


def test_an_odd_path_stays_one_word_of_the_kernel_command_line() -> None:
    arguments = kernel_arguments("/a b/python", "/c d", REQUEST, 5, 6, 7)
    assert 'init="/a b/python"' in arguments
    assert arguments[-1] == '"/c d"'
    assert {"mem=256M", "con1=null,fd:5", "con2=null,fd:6", "con3=fd:7"} <= set(arguments)
    assert arguments.index("--") > arguments.index('init="/a b/python"')


def test_a_path_with_a_quote_is_refused() -> None:
    with pytest.raises(LabError, match="cannot carry the path"):
        kernel_arguments('/a"b/python', "/", REQUEST, 5, 6, 7)


@pytest.mark.parametrize("name", ["", "sixteen-letters-", "a b", "a/b", "a:b", ".."])
def test_an_impossible_interface_name_is_refused(name: str) -> None:
    assert link_fault(name)


def test_an_interface_name_passes() -> None:
    assert link_fault("fifteen-letters") is None


# ------------------------------------------------------------------------------- the shim
def test_only_a_cpu_with_amx_needs_the_shim() -> None:
    assert shim.needed("model\t: x\nflags\t\t: fpu amx_tile avx\nbugs\t: y\n")
    assert not shim.needed("flags\t\t: fpu avx512f\nbugs\t: amx_tile\n")
    assert not shim.needed("")


def test_the_shim_is_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not any(Path(folder, "cc").exists() for folder in os.get_exec_path()):
        pytest.skip("no C compiler")
    built = shim.library(tmp_path / "cache")
    assert built.read_bytes().startswith(b"\x7fELF")
    monkeypatch.setenv("PATH", "/nowhere")
    assert shim.library(tmp_path / "cache") == built
    assert os.listdir(built.parent) == [built.name]


def test_without_a_compiler_a_sentence_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(LabError, match="apt-get install gcc libc6-dev"):
        shim.library(tmp_path)


# ------------------------------------------------------------------------------- real runs
@pytest.fixture(scope="module")
def lab() -> Iterator[Run]:
    """Runs ``python -m hil.vcan_lab *arguments``; skips where this machine has no way to a lab."""
    require_lab()

    def run(*arguments: str, cwd: Path = ROOT, **env: str) -> subprocess.CompletedProcess[bytes]:
        return subprocess.run(
            [*LAB, *arguments], cwd=cwd, env=environment(**env), capture_output=True, timeout=100, check=False
        )  # fmt: skip

    yield run


def require_lab() -> str:
    try:
        return choose(survey(replace(REQUEST, uid=os.getuid()))).kind
    except LabError as reason:
        pytest.skip(str(reason))


def environment(**changed: str) -> dict[str, str]:
    paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": paths, **changed}


def descendants(pid: int) -> set[int]:
    """Processes below ``pid``, whatever group or session they are in."""
    parents: dict[int, int] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rsplit(")", 1)[1].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if fields[0] != "Z":
            parents[int(stat.parent.name)] = int(fields[1])
    found, grown = set(), {pid}
    while grown:
        grown = {child for child, parent in parents.items() if parent in grown} - found
        found |= grown
    return found


def wait_until(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.02)


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "status"),
    [(["sh", "-c", "kill -TERM $$"], 128 + 15), (["no-such-command"], 127), (["/"], 126)],
)
def test_how_a_command_ends(lab: Run, command: list[str], status: int) -> None:
    done = lab("--", *command)
    assert (done.returncode, done.stdout) == (status, b"")
    assert (b"vcan lab: " in done.stderr) == (status < 128)


@pytest.mark.slow
def test_candump_sees_a_frame_from_a_python_socket(lab: Run) -> None:
    if not any(Path(folder, "candump").exists() for folder in os.get_exec_path()):
        pytest.skip("candump is missing (apt-get install can-utils)")
    script = """if True:
        import subprocess
        from can_dbc.bus import open_bus
        dump = subprocess.Popen(["candump", "-n", "1", "vcan0"], stdout=subprocess.PIPE)
        with open_bus("socketcan:vcan0") as bus:
            while dump.poll() is None:
                bus.send(0x210, bytes.fromhex("0123456789ABCDEF"))
        print(*dump.stdout.read().decode().split(), end="")
    """
    done = lab("--timeout", "20", "--", sys.executable, "-c", script)
    assert done.stdout.decode() == "vcan0 210 [8] 01 23 45 67 89 AB CD EF", done.stderr


@pytest.mark.slow
def test_a_command_out_of_time_is_ended_even_if_it_will_not(
    lab: Run,
) -> None:
    done = lab("--timeout", "2", "--", "sh", "-c", "trap 'echo told; trap \"\" TERM' TERM; while :; do :; done")
    assert (done.returncode, done.stdout) == (124, b"told\n")


@pytest.mark.slow
def test_files_written_inside_lie_outside_whatever_the_folder(lab: Run, tmp_path: Path) -> None:
    """Working directory, temporary directory: with a space and a letter beyond ASCII; two labs at once."""
    odd = tmp_path / "an odd földer"
    odd.mkdir()
    script = (
        'echo "$TIMBERHAND_LAB" > log.txt; dd if=/dev/zero of=big bs=1000 count=3000 2>/dev/null; mktemp -p "$TMPDIR"'
    )
    beside = subprocess.Popen(
        [*LAB, "--", "sh", "-c", "echo beside > beside.txt; ip -brief link"],
        cwd=odd, env=environment(), stdout=subprocess.PIPE,
    )  # fmt: skip
    done = lab("--", "sh", "-c", script, cwd=odd, TMPDIR=str(odd))
    assert b"vcan1" in beside.communicate(timeout=PATIENCE_S)[0]
    made = Path(os.fsdecode(done.stdout.strip()))
    assert done.returncode == beside.returncode == 0
    assert sorted(odd.iterdir()) == sorted([odd / "log.txt", odd / "big", odd / "beside.txt", made])
    assert (odd / "log.txt").read_text().strip() in ("uml", "native")
    assert (odd / "big").read_bytes() == bytes(3_000_000)


@pytest.mark.slow
def test_a_reader_that_goes_away_ends_the_writer(lab: Run) -> None:
    endless = subprocess.Popen([*LAB, "--", "yes"], cwd=ROOT, env=environment(), stdout=subprocess.PIPE)
    assert endless.stdout and endless.stdout.readline() == b"y\n"
    endless.stdout.close()
    assert endless.wait(PATIENCE_S) == 128 + signal.SIGPIPE


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_lab_leaves_nothing_behind(number: signal.Signals, tmp_path: Path) -> None:
    """Ctrl-C reaches the command; a killed wrapper takes every process with it; no file is left."""
    way = require_lab()
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    wrapper = subprocess.Popen(
        [*LAB, "--", "sh", "-c", "echo up; while :; do :; done"],
        cwd=ROOT, env=environment(TMPDIR=str(temporary)), stdout=subprocess.PIPE,
    )  # fmt: skip
    assert wrapper.stdout and wrapper.stdout.readline() == b"up\n"
    below = descendants(wrapper.pid)
    assert len(below) >= (4 if way == "uml" else 2)
    wrapper.send_signal(number)
    assert wrapper.wait(PATIENCE_S) == (130 if number == signal.SIGINT else -signal.SIGKILL)
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in below), f"left behind: {below}")
    assert list(temporary.iterdir()) == []


@pytest.mark.slow
def test_a_killed_user_mode_kernel_is_reported(tmp_path: Path) -> None:
    if require_lab() != "uml":
        pytest.skip("this machine's kernel has CAN")
    wrapper = subprocess.Popen(
        [*LAB, "--", "sh", "-c", "echo up; while :; do :; done"],
        cwd=ROOT, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert wrapper.stdout and wrapper.stdout.readline() == b"up\n"
    below = descendants(wrapper.pid)
    keeper = min(below)
    kernel = min(descendants(keeper))
    os.kill(kernel, signal.SIGKILL)
    _, complaint = wrapper.communicate(timeout=PATIENCE_S)
    assert wrapper.returncode == 4
    assert b"the guest died" in complaint
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in below), f"left behind: {below}")


@pytest.mark.slow
def test_the_shim_does_no_harm_where_it_is_not_needed(lab: Run, tmp_path: Path) -> None:
    if require_lab() != "uml" or not any(Path(folder, "cc").exists() for folder in os.get_exec_path()):
        pytest.skip("needs user-mode Linux and a C compiler")
    wrapper = (
        "import sys; from hil.vcan_lab import shim; shim.needed = lambda text: True; "
        "import typer; from hil.vcan_lab.__main__ import CONTEXT, vcan; "
        "app = typer.Typer(); app.command(context_settings=CONTEXT)(vcan); app()"
    )
    cache = tmp_path / "a cache: odd"
    done = subprocess.run(
        [sys.executable, "-c", wrapper, sys.executable, "-c", "print(sum(i * 0.5 for i in range(1000)))"],
        cwd=ROOT, env=environment(XDG_CACHE_HOME=str(cache)), capture_output=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, b"249750.0\n"), done.stderr
    assert [path.name for path in (cache / "timberhand").iterdir()] == ["xstate_shim.so"]


def test_check_prints_the_way_and_why() -> None:
    done = subprocess.run([*LAB, "--check", "--json"], cwd=ROOT, env=environment(), capture_output=True, check=False)
    found = json.loads(done.stdout)
    assert set(found) == {"way", "why", "kernel", "links"}
    assert done.returncode == (4 if found["way"] is None else 0)


def test_without_kernel_support_and_without_the_package_the_exit_status_is_4(tmp_path: Path) -> None:
    if survey(REQUEST).can_fault is None:
        pytest.skip("this machine's kernel has CAN")
    done = subprocess.run(
        [*LAB, "--", "true"], cwd=ROOT, env=environment(PATH=str(tmp_path)), capture_output=True, check=False
    )
    assert (done.returncode, done.stdout) == (4, b"")
    assert done.stderr.decode().count("\n") == 1
    assert "apt-get install user-mode-linux" in done.stderr.decode()


def test_no_command_is_a_usage_error() -> None:
    done = subprocess.run(LAB, cwd=ROOT, env=environment(), capture_output=True, check=False)
    assert done.returncode == 2


@pytest.mark.slow
def test_the_live_bus_tests_pass_in_the_lab(lab: Run, tmp_path: Path) -> None:
    """tests/vcan and the contract of all buses, which takes SocketCAN in where the kernel has it."""
    way = require_lab()
    done = lab(
        "--timeout", "80", "--root", "--",
        sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--basetemp={tmp_path / 'inside'}",
        "tests/vcan", "tests/can_dbc/test_bus_contract.py", "-k", "vcan or socketcan or kernel or link",
    )  # fmt: skip
    report = done.stdout.decode()
    assert done.returncode == 0, report[-3000:] + done.stderr.decode()
    if way == "uml":  # root, FIFO and every interface are there: nothing but foreign tools may be missing
        skips = [line for line in report.splitlines() if line.startswith("SKIPPED")]
        assert all("apt-get install can-utils" in line for line in skips), report


def test_what_the_command_leaves_behind_is_ended_natively_too(tmp_path: Path) -> None:
    """A process that left the command's group and session is still below the lab."""
    script = (
        "import os, sys; from hil.vcan_lab.choose import Way; from hil.vcan_lab.host import run\n"
        "from hil.vcan_lab.spec import Request\n"
        "argv = ('sh', '-c', 'setsid sleep 300 & echo $! > left; sleep 0.5')\n"
        "request = Request(argv=argv, cwd=sys.argv[1], env=dict(os.environ), uid=os.getuid(), gid=os.getgid(),\n"
        "                  groups=tuple(os.getgroups()), umask=0o22)\n"
        "sys.exit(run(request, Way('existing', 'for this test', None)))\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], cwd=ROOT, timeout=PATIENCE_S)
    assert done.returncode == 0
    left = int((tmp_path / "left").read_text())
    wait_until(lambda: not Path(f"/proc/{left}").exists(), f"process {left} is left behind")
