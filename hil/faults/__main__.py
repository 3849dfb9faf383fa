"""``python -m hil.faults``: the desk at which the page of a live run orders faults (`hil.faults.__main__`)."""

from __future__ import annotations

import argparse
import json
import os
import signal
import socketserver
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from can_dbc.bus.factory import PYTHON_CAN, VCAN_NAMES
from hil.faults.live import LiveTarget, inject
from hil.faults.table import FAULTS, Edge, parse
from runtime.errors import InputRefused
from runtime.shared_file import make_own_folder

# -- The faults that the page of a live run offers, and the socket on which it orders them.
#
# Only `hil.harness.live` starts this process, so only the page of a live run has a socket to it; on a machine there
# is none.  It refuses, too, when a bus of the run is neither the wire nor a vcan.  A request is one line of JSON,
# ``{"op": "list"}`` or ``{"op": "inject", "name": ...}``, and so is the answer: ``faults``, or ``at_ns``
# (monotonic, when the fault began) and ``said``, or ``error``.

MAX_REQUEST_BYTES: Final = 4096


@dataclass(frozen=True, slots=True)
class Offer:
    """One button: what a person reads, and the order behind it."""

    title: str
    order: str


OFFERS: Final[dict[str, Offer]] = {
    "encoder-frozen": Offer("Encoder of the lift freezes for 2 s", "encoder-stuck/lift+2s"),
    "encoder-silent": Offer("Encoder of the lift is unplugged for 2 s", "message-off/EncLift+2s"),
    "encoder-jump": Offer("Encoder of the lift is 0.2 rad wrong for 2 s", "encoder-jump/lift+2s=0.2"),
    "spool-off": Offer("Lift spool is off its command for 2 s", "valve-drift/lift+2s=0.4"),
    "hose-burst": Offer("Hose of the lift bursts for 2 s", "hose-burst/lift+2s"),
    "person": Offer("A person steps into the zone for 1 s", "person-in-zone+1s"),
    "estop": Offer("The emergency stop is pressed for 1 s", "estop-pressed+1s"),
    "bus-cut": Offer("The controller's CAN cable is open for 0.3 s", "bus-stub/crane0+300ms"),
    "frames-corrupt": Offer("Valve feedback is corrupted for 0.3 s", "bus-corrupt/ValveFbA+300ms"),
    "planner-frozen": Offer("The planner freezes for 1 s", "process-stuck/planner+1s"),
    "controller-frozen": Offer("The controller freezes for 0.2 s", "process-stuck/controller+200ms"),
    "forged-arm": Offer("Someone forges ARM and RESET for 1 s", "planner-arms+1s"),
}


def answer(request: dict[str, Any], run: Path) -> dict[str, Any]:
    """Answer one request of the page; ``run`` is the directory of the live run."""
    try:
        target = _emulated(run)
        match request:
            case {"op": "list"}:
                return {"faults": [_described(name, target) for name in OFFERS]}
            case {"op": "inject", "name": str(name)} if name in OFFERS:
                order = parse(OFFERS[name].order, time.monotonic_ns() & 0xFFFF)
                at_ns = time.monotonic_ns()
                return {"at_ns": at_ns, "title": OFFERS[name].title, "said": inject(order, target)}
    except InputRefused as error:
        return {"error": str(error)}
    return {"error": "this fault is not offered"}


def _emulated(run: Path) -> LiveTarget:
    """Return the live run if nothing of it can be a machine, else raise InputRefused."""
    target = LiveTarget.of(run)
    virtual = {f"{ours}socketcan:{name}" for name in VCAN_NAMES.values() for ours in ("", PYTHON_CAN)}
    for bus, address in target.buses.items():
        if not address.startswith("wire:") and address not in virtual:
            raise InputRefused(
                "fault.real-bus-page", f"{bus} is {address}, which may be a machine; nothing is injected"
            )
    return target


def _described(name: str, target: LiveTarget) -> dict[str, str]:
    order = parse(OFFERS[name].order)
    kind = FAULTS[order.fault]
    needs_wire = kind.edge is Edge.BUS and not all(a.startswith("wire:") for a in target.buses.values())
    why_not = "needs the wire (--bus wire)" if needs_wire else ""
    return {"name": name, "title": OFFERS[name].title, "what": f"{order.fault}: {kind.summary}", "why_not": why_not}


class _Handler(socketserver.StreamRequestHandler):
    timeout = 10

    def handle(self) -> None:
        try:
            request = json.loads(self.rfile.readline(MAX_REQUEST_BYTES))
            assert isinstance(self.server, Desk)
            response = answer(request, self.server.run) if isinstance(request, dict) else {"error": "not a request"}
        except (ValueError, OSError):
            response = {"error": "not a request"}
        self.wfile.write(json.dumps(response).encode() + b"\n")


class Desk(socketserver.ThreadingMixIn, socketserver.UnixStreamServer):
    """Serves requests at a socket of this user alone, until it is closed."""

    daemon_threads = True

    def __init__(self, path: Path, run: Path) -> None:
        self.run = run
        # The first process of a run, on a computer that was just started: nobody has made the folder yet.
        make_own_folder(path.parent)
        path.unlink(missing_ok=True)
        before = os.umask(0o177)
        try:
            super().__init__(str(path), _Handler)
        finally:
            os.umask(before)


def main() -> int:
    """Serve until SIGINT or SIGTERM."""
    parser = argparse.ArgumentParser(prog="python -m hil.faults", description="Faults for the page of a live run.")
    parser.add_argument("--run", type=Path, required=True, metavar="DIR", help="directory of the live run")
    parser.add_argument("--socket", type=Path, required=True, metavar="FILE", help="socket to serve at")
    a = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # also where a shell started it with SIGINT ignored
    try:
        with Desk(a.socket, a.run) as desk:
            print(json.dumps({"ready": True}), flush=True)
            desk.serve_forever(0.2)
    except KeyboardInterrupt:
        pass
    finally:
        a.socket.unlink(missing_ok=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
