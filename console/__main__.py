"""``python -m console``: serves the operator's page until it is interrupted.

Once the page can be opened, one JSON line with its ``url`` is written to stdout.

Exit codes: 0 interrupted, 2 usage, 3 configuration, 4 a port is in use.
"""

from __future__ import annotations

import argparse
import ipaddress
import json
import signal
import socket
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from machine.loading.profile_file import ProfileError, load_profile, profile_hash
from runtime.errors import CodedError


class StartError(CodedError):
    """The console cannot start: an error code, one sentence and the exit code of the process."""

    def __init__(self, code: str, sentence: str, exit_code: int) -> None:
        super().__init__(code, sentence)
        self.exit_code = exit_code

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.code, str(self), self.exit_code)


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
) -> None:
    """Serve until SIGINT or SIGTERM.

    Raises:
        StartError: the console cannot start.
    """
    from console.server import Console, create_app

    try:
        machine = load_profile(profile)
        key = key_file.read_bytes().strip() if key_file else None
    except ProfileError as error:
        raise StartError(error.code, str(error), 3) from error
    except OSError as error:
        sentence = f"{key_file} cannot be read ({error.strerror}); give the file with the key"
        raise StartError("console.key-file", sentence, 3) from error
    page = _listen(socket.SOCK_STREAM, bind, port, "--port")
    reports = _listen(socket.SOCK_DGRAM, "127.0.0.1", report_port, "--report-port")
    console = Console(
        profile=machine,
        profile_hash=profile_hash(machine),
        operator=operator,
        planner=_address(planner, "--planner"),
        scene=_address(scene, "--scene"),
        key=key,
        reports=reports,
        timing_page=timing,
    )
    _run(create_app(console, (*allow_hosts, bind)), page, bind)


def serve_plant(*, port: int, plant: str, bind: str = "127.0.0.1", allow_hosts: Sequence[str] = ()) -> None:
    """Serve the view of a simulated plant until SIGINT or SIGTERM.

    Raises:
        StartError: the console cannot start.
    """
    from console.plant_view import create_plant_app

    address = _address(plant, "--plant")
    assert address is not None
    _run(create_plant_app(address, (*allow_hosts, bind)), _listen(socket.SOCK_STREAM, bind, port, "--port"), bind)


def _run(app: Any, page: socket.socket, bind: str) -> None:
    """Write the page's address to stdout and serve it."""
    import uvicorn

    # A page that keeps its websocket open must not delay the shutdown.
    config = uvicorn.Config(app, log_level="warning", timeout_graceful_shutdown=1, ws="websockets-sansio")
    host = f"[{bind}]" if ":" in bind else bind
    sys.stdout.write(json.dumps({"url": f"http://{host}:{page.getsockname()[1]}/"}) + "\n")
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
        sentence = f"cannot use {host}:{port} ({error.strerror}); choose another {option}"
        raise StartError("console.port-in-use", sentence, 4) from error
    return s


def _address(text: str | None, option: str) -> tuple[str, int] | None:
    if text is None:
        return None
    host, _, port = text.rpartition(":")
    try:
        return str(ipaddress.ip_address(host or "127.0.0.1")), int(port)
    except ValueError:
        sentence = f"{option} {text} is not HOST:PORT, as in 127.0.0.1:5005"
        raise StartError("console.address", sentence, 2) from None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the process; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m console", description="The operator's web page.")
    parser.add_argument("--port", type=int, default=8471, help="port of the page (default 8471)")
    parser.add_argument("--report-port", type=int, help="UDP port that receives the reports of controller and planner")
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
    a = parser.parse_args(arguments)
    if (a.report_port is None) == (a.plant is None):
        parser.error("give --report-port (the operator's page) or --plant (the view of a simulated plant)")
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGINT))
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
        )
    except StartError as error:
        sys.stderr.write(f"console: {error}\n")
        return error.exit_code
    except KeyboardInterrupt:
        return 0
    return 0


if __name__ == "__main__":
    sys.exit(main())
