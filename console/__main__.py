"""``python -m console``: serves the operator's page until it is interrupted.

When the page can be opened, one JSON line with its ``url`` goes to stdout.

Exit codes: 0 interrupted in good order, 2 usage, 3 configuration, 4 a port is busy.
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


class Refused(Exception):
    """The console cannot start: the exit code and one sentence."""

    def __init__(self, code: int, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code


def serve(
    *,
    port: int,
    report_port: int,
    profile: str,
    controller: str | None = None,
    planner: str | None = None,
    scene: str | None = None,
    bind: str = "127.0.0.1",
    allow_hosts: Sequence[str] = (),
    key_file: Path | None = None,
    timing: Path | None = None,
) -> None:
    """Serve until SIGINT or SIGTERM; raises `Refused`."""
    from console.server import Console, create_app

    try:
        machine = load_profile(profile)
        key = key_file.read_bytes().strip() if key_file else None
    except ProfileError as error:
        raise Refused(3, str(error)) from error
    except OSError as error:
        raise Refused(3, f"{key_file} cannot be read ({error.strerror}); give the file with the key") from error
    page = _listen(socket.SOCK_STREAM, bind, port, "--port")
    reports = _listen(socket.SOCK_DGRAM, "127.0.0.1", report_port, "--report-port")
    console = Console(
        profile=machine,
        profile_hash=profile_hash(machine),
        controller=_address(controller, "--controller"),
        planner=_address(planner, "--planner"),
        scene=_address(scene, "--scene"),
        key=key,
        reports=reports,
        timing_page=timing,
    )
    _run(create_app(console, (*allow_hosts, bind)), page, bind)


def serve_plant(*, port: int, plant: str, bind: str = "127.0.0.1", allow_hosts: Sequence[str] = ()) -> None:
    """Serve the view of a simulated plant until SIGINT or SIGTERM; raises `Refused`."""
    from console.plant_view import create_plant_app

    address = _address(plant, "--plant")
    assert address is not None
    _run(create_plant_app(address, (*allow_hosts, bind)), _listen(socket.SOCK_STREAM, bind, port, "--port"), bind)


def _run(app: Any, page: socket.socket, bind: str) -> None:
    """Say where the page is and serve it."""
    import uvicorn

    # A page that keeps its websocket open must not hold up the end.
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
        raise Refused(4, f"cannot use {host}:{port} ({error.strerror}); choose another {option}") from error
    return s


def _address(text: str | None, option: str) -> tuple[str, int] | None:
    if text is None:
        return None
    host, _, port = text.rpartition(":")
    try:
        return str(ipaddress.ip_address(host or "127.0.0.1")), int(port)
    except ValueError:
        raise Refused(2, f"{option} {text} is not HOST:PORT, as in 127.0.0.1:5005") from None


def main(arguments: Sequence[str] | None = None) -> int:
    """The process; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m console", description="The operator's web page.")
    parser.add_argument("--port", type=int, default=8471, help="of the page (default 8471)")
    parser.add_argument("--report-port", type=int, help="UDP port of the reports of controller and planner")
    parser.add_argument("--plant", metavar="HOST:PORT", help="show the simulated plant that answers there instead")
    parser.add_argument("--profile", default="palms_471", help="shipped name or TOML file")
    parser.add_argument("--controller", metavar="HOST:PORT", help="where commands go; without it the page only watches")
    parser.add_argument("--planner", metavar="HOST:PORT", help="where the orders to a mission go")
    parser.add_argument("--scene", metavar="HOST:PORT", help="a detector to ask for the logs that lie there")
    parser.add_argument("--bind", default="127.0.0.1", help="address to serve on (default: this machine only)")
    parser.add_argument("--allow-host", action="append", default=[], help="a host name to serve besides this machine's")
    parser.add_argument("--key-file", type=Path, help="file with the key of authenticated datagrams")
    parser.add_argument("--timing", type=Path, metavar="FILE", help="the controller's timing page, to be shown")
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
            controller=a.controller,
            planner=a.planner,
            scene=a.scene,
            bind=a.bind,
            allow_hosts=a.allow_host,
            key_file=a.key_file,
            timing=a.timing,
        )
    except Refused as refused:
        sys.stderr.write(f"console: {refused}\n")
        return refused.code
    except KeyboardInterrupt:
        return 0
    return 0


if __name__ == "__main__":
    sys.exit(main())
