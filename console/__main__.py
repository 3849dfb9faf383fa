"""``python -m console``: serves the operator's page until it is interrupted.

Once the page can be opened, one JSON line with its ``url`` is written to stdout.  Where nobody has a password the
address carries the token that opens a session (`console.access`): whoever has it may command.

Exit codes: 0 interrupted, 2 usage, 3 configuration, 4 a port is in use.
"""

from __future__ import annotations

import argparse
import errno
import ipaddress
import json
import signal
import socket
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from can_dbc.messages.envelope import read_key
from console.access_guards import ENTRY, AuditLog
from console.exposure import Exposure, StartError, check_local
from machine.loading.profile_file import ProfileError, load_profile, profile_check, profile_file, profile_hash
from machine.profile import Profile
from runtime.errors import ConfigError

if TYPE_CHECKING:
    from console.foxglove_server import FoxgloveServer
    from console.replay import Recording

LOCAL: Final = Exposure()
MAX_PORT: Final = 65535
COMMISSION: Final = Path("commissioning")
"""Default folder of what commissioning writes."""


def serve(
    *,
    port: int,
    report_port: int,
    profile: str,
    operator: Path | None = None,
    planner: str | None = None,
    scene: str | None = None,
    bind: str = "127.0.0.1",
    allow_hosts: Sequence[str] = (),
    key_file: Path | None = None,
    timing: Path | None = None,
    missions: Path | None = None,
    buses: Sequence[str] = (),
    faults: Path | None = None,
    truth: str | None = None,
    foxglove: int | None = None,
    recording: Path | None = None,
    exposure: Exposure = LOCAL,
    controller: str | None = None,
    commission: Path = COMMISSION,
) -> None:
    """Serve until SIGINT or SIGTERM.

    Raises:
        StartError: the console cannot start.
    """
    from console.console import CommissionOptions, Console
    from console.foxglove_server import FoxgloveServer
    from console.server import create_app

    try:
        machine, check = load_profile(profile), profile_check(profile)
        key = None if key_file is None else read_key(key_file)
    except ProfileError as error:
        raise StartError(error.code, str(error), 3) from error
    except ConfigError as error:
        raise StartError("console.key-file", str(error), 3) from error
    setpoints, named = _address(controller, "--controller"), _buses(buses, machine)
    if setpoints is not None and machine.crane_bus not in named:
        sentence = f"--controller commissions the crane and needs its bus; give --bus {machine.crane_bus}=ADDRESS"
        raise StartError("console.commission-bus", sentence, 2)
    exposure = exposure.with_credentials()
    accounts = exposure.check(bind)
    page = _listen(socket.SOCK_STREAM, bind, port, "--port")
    reports = _listen(socket.SOCK_DGRAM, "127.0.0.1", report_port, "--report-port")
    try:
        live = None if foxglove is None else FoxgloveServer(machine, bind, foxglove)
    except OSError as error:
        sentence = f"Foxglove cannot be served on {bind}:{foxglove} ({error}); choose another --foxglove"
        raise StartError("console.port-in-use", sentence, 4) from error
    console = Console(
        profile=machine,
        profile_hash=profile_hash(machine),
        profile_check=check,
        operator=operator,
        planner=_address(planner, "--planner"),
        scene=_address(scene, "--scene"),
        key=key,
        reports=reports,
        timing_page=timing,
        missions=missions,
        buses=named,
        faults=faults,
        truth=_address(truth, "--truth"),
        foxglove=live,
        recording=recording,
        commission=None if setpoints is None else CommissionOptions(setpoints, profile_file(profile), commission),
        accounts=accounts,
        audit=_audit(exposure.audit),
        tls=exposure.tls_cert is not None,
    )
    try:
        _run(create_app(console, (*allow_hosts, bind)), page, bind, exposure, live, console.access.token)
    finally:
        if console.audit is not None:
            console.audit.close()


def serve_replay(
    recording: Recording,
    machine: Profile,
    *,
    port: int,
    name: str,
    note: str = "",
    at_ns: int | None = None,
    bind: str = "127.0.0.1",
    allow_hosts: Sequence[str] = (),
) -> None:
    """Serve a recorded run until SIGINT or SIGTERM; ``at_ns`` is where a page begins.

    Raises:
        StartError: the console cannot start.
    """
    from console.replay_server import create_replay_app

    check_local(bind, "a recording")
    page = _listen(socket.SOCK_STREAM, bind, port, "--port")
    app = create_replay_app(recording, machine, name=name, note=note, at_ns=at_ns, allow_hosts=(*allow_hosts, bind))
    _run(app, page, bind)


def serve_plant(*, port: int, plant: str, bind: str = "127.0.0.1", allow_hosts: Sequence[str] = ()) -> None:
    """Serve the view of a simulated plant until SIGINT or SIGTERM.

    Raises:
        StartError: the console cannot start.
    """
    from console.plant_link import create_plant_app

    check_local(bind, "the view of a plant")
    address = _address(plant, "--plant")
    assert address is not None
    _run(create_plant_app(address, (*allow_hosts, bind)), _listen(socket.SOCK_STREAM, bind, port, "--port"), bind)


def _run(
    app: Any,
    page: socket.socket,
    bind: str,
    exposure: Exposure = LOCAL,
    live: FoxgloveServer | None = None,
    token: str = "",
) -> None:
    """Write the page's address to stdout, and that for Foxglove, and serve it."""
    import uvicorn

    # A page that keeps its websocket open must not delay the shutdown.
    config = uvicorn.Config(
        app,
        log_level="warning",
        timeout_graceful_shutdown=1,
        ws="websockets-sansio",
        server_header=False,
        ssl_certfile=exposure.tls_cert,
        ssl_keyfile=exposure.tls_key,
    )
    scheme = "https" if exposure.tls_cert else "http"
    host = f"[{bind}]" if ":" in bind else bind
    query = f"?{ENTRY}={token}" if token else ""
    addresses = {"url": f"{scheme}://{host}:{page.getsockname()[1]}/{query}"}
    if live is not None:
        addresses["foxglove"] = f"ws://{host}:{live.port}"
    sys.stdout.write(json.dumps(addresses) + "\n")
    sys.stdout.flush()
    uvicorn.Server(config).run(sockets=[page])


def _listen(kind: socket.SocketKind, host: str, port: int, option: str) -> socket.socket:
    s = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, kind)
    if kind is socket.SOCK_STREAM:
        s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    s.setblocking(False)
    try:
        s.bind((host, port))
        if kind is socket.SOCK_STREAM:
            s.listen(64)
    except OSError as error:
        s.close()
        if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
            sentence = f"{host} is no address of this computer ({error.strerror}); choose another --bind"
            raise StartError("console.bind", sentence, 2) from error
        sentence = f"cannot use {host}:{port} ({error.strerror}); choose another {option}"
        raise StartError("console.port-in-use", sentence, 4) from error
    return s


def _audit(path: Path | None) -> AuditLog | None:
    if path is None:
        return None
    try:
        return AuditLog(path, time.monotonic_ns)
    except OSError as error:
        sentence = f"the audit log {path} cannot be written ({error.strerror}); choose another --audit"
        raise StartError("console.audit", sentence, 3) from error


def _buses(texts: Sequence[str], profile: Profile) -> dict[str, str]:
    addresses = dict(text.partition("=")[::2] for text in texts)
    known = [bus for bus in (profile.crane_bus, profile.machine_bus) if bus]
    for name, address in addresses.items():
        if name not in known or not address:
            sentence = f"--bus {name}={address} is not NAME=ADDRESS with a bus of {profile.name} ({', '.join(known)})"
            raise StartError("console.bus", sentence, 2)
    return addresses


def _address(text: str | None, option: str) -> tuple[str, int] | None:
    if text is None:
        return None
    host, _, port = text.rpartition(":")
    try:
        address = str(ipaddress.IPv4Address(host or "127.0.0.1")), _port(port)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            link.connect(address)
    except (ValueError, argparse.ArgumentTypeError):
        sentence = f"{option} {text} is not HOST:PORT with an IPv4 address, as in 127.0.0.1:5005"
        raise StartError("console.address", sentence, 2) from None
    except OSError as error:
        sentence = f"{option} {text} cannot be reached from this computer ({error.strerror}); give another address"
        raise StartError("console.address", sentence, 2) from None
    return address


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > MAX_PORT:
        raise argparse.ArgumentTypeError(f'"{text}" is no port; a port is a number from 0 to {MAX_PORT}')
    return int(text)


def command_line() -> argparse.ArgumentParser:
    """Build the parser of the process's command line."""
    parser = argparse.ArgumentParser(prog="python -m console", description="The operator's web page.")
    parser.add_argument("--port", type=_port, default=8471, help="port of the page (default 8471)")
    parser.add_argument(
        "--report-port", type=_port, help="UDP port that receives the reports of controller and planner"
    )
    parser.add_argument("--plant", metavar="HOST:PORT", help="request port of a simulated plant to show instead")
    parser.add_argument("--profile", default="palms_471", help="shipped name or TOML file")
    parser.add_argument(
        "--operator",
        type=Path,
        metavar="FILE",
        help="the controller's socket for operator commands; without it the page is read-only",
    )
    parser.add_argument(
        "--planner", metavar="HOST:PORT", help="planner that receives mission commands (its --order-port)"
    )
    parser.add_argument("--scene", metavar="HOST:PORT", help="log detector to request logs from")
    parser.add_argument("--bind", default="127.0.0.1", help="address to serve on (default: this machine only)")
    parser.add_argument(
        "--allow-host", action="append", default=[], help="host name to serve in addition to this machine's"
    )
    parser.add_argument("--key-file", type=Path, help="file with the key of authenticated datagrams")
    parser.add_argument("--timing", type=Path, metavar="FILE", help="timing page of the controller to show")
    parser.add_argument("--missions", type=Path, metavar="DIR", help="folder of the missions planned on the page")
    parser.add_argument(
        "--bus",
        action="append",
        default=[],
        metavar="NAME=ADDRESS",
        help="bus whose frames the page may show, as for the recorder; only listens, and only while a page shows them",
    )
    parser.add_argument(
        "--faults", type=Path, metavar="FILE", help="socket of a live run's desk of faults, given by its harness"
    )
    parser.add_argument(
        "--truth",
        metavar="HOST:PORT",
        help="request port of an emulated run's plant, to show its true logs",
    )
    parser.add_argument(
        "--foxglove", type=_port, metavar="PORT", help="port that serves the run to Foxglove and Lichtblick, read-only"
    )
    parser.add_argument(
        "--recording",
        type=Path,
        metavar="DIR",
        help="directory of the run's recording, which the page names at its end",
    )
    parser.add_argument(
        "--controller", metavar="HOST:PORT", help="the controller's setpoint port, for the page of commissioning"
    )
    parser.add_argument("--commission", type=Path, metavar="DIR", default=COMMISSION, help="folder of what it writes")
    parser.add_argument("--passwords", type=Path, metavar="FILE", help="accounts of the page's users")
    parser.add_argument("--tls-cert", type=Path, metavar="FILE", help="certificate of the page, PEM")
    parser.add_argument("--tls-key", type=Path, metavar="FILE", help="its key, PEM")
    parser.add_argument("--audit", type=Path, metavar="FILE", help="log to which every command is appended")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the process; returns its exit code."""
    parser = command_line()
    a = parser.parse_args(arguments)
    if (a.report_port is None) == (a.plant is None):
        parser.error("give --report-port (the operator's page) or --plant (the view of a simulated plant)")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        if a.plant is not None:
            serve_plant(port=a.port, plant=a.plant, bind=a.bind, allow_hosts=a.allow_host)
            return 0
        serve(
            port=a.port,
            report_port=a.report_port,
            profile=a.profile,
            operator=a.operator,
            planner=a.planner,
            scene=a.scene,
            bind=a.bind,
            allow_hosts=a.allow_host,
            key_file=a.key_file,
            timing=a.timing,
            missions=a.missions,
            buses=a.bus,
            faults=a.faults,
            truth=a.truth,
            foxglove=a.foxglove,
            recording=a.recording,
            exposure=Exposure(a.passwords, a.tls_cert, a.tls_key, a.audit),
            controller=a.controller,
            commission=a.commission,
        )
    except StartError as error:
        sys.stderr.write(f"console: {error}\n")
        return error.exit_code
    except KeyboardInterrupt:
        return 0
    return 0


if __name__ == "__main__":
    sys.exit(main())
