"""Faults in a live run: the plant does them on request, the wire damages frames, processes get signals.

A run is reached by the file that `hil.harness.live` leaves in its directory.  On a real bus only frames can be added,
and only with ``consent``; everything else there is done by hand, with a plug.
"""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import time
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, Final

from can_dbc.bus.factory import open_bus
from can_dbc.bus.wire_client import control
from can_dbc.messages.crane import OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import encode
from can_dbc.messages.envelope import read_key
from hil.faults.table import FAULTS, Edge, Order
from hil.faults.wire_faults import wire_fault
from hil.harness.live import ADDRESSES, HOST
from hil.wire.faults import FOREVER_NS, Fault, Kind
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import Profile
from runtime.errors import ConfigError, InputRefused, LinkError

ANSWER_S: Final = 2.0
FLOOD_PERIOD_S: Final = 0.01
_PROCESSES: Final = {"planner": "autonomy", "controller": "controller", "guard": "guard"}


@dataclass(frozen=True, slots=True)
class LiveTarget:
    """Where a live run can be reached."""

    profile: Profile
    ports: dict[str, int]
    buses: dict[str, str]
    pids: dict[str, int]
    key_file: Path

    @classmethod
    def of(cls, directory: Path) -> LiveTarget:
        """Return the live run that records in a directory.

        Raises:
            InputRefused: no live run has left its addresses there.
        """
        path = directory / ADDRESSES
        try:
            addresses = json.loads(path.read_text())
            profile, key_file = load_profile(addresses["profile"]), Path(addresses["key_file"])
            return cls(profile, addresses["ports"], addresses["buses"], addresses["pids"], key_file)
        except (OSError, ValueError, KeyError) as error:
            raise InputRefused(
                "fault.no-live-run", f"{path} cannot be read ({error}); give the directory of a live run with --run"
            ) from None


def inject(order: Order, target: LiveTarget, consent: bool = False) -> str:
    """Wait for the order's time, begin it, and return a sentence of what was done; blocks while it lasts where this
    process itself does it.

    Raises:
        InputRefused: this fault cannot be injected into this run.
    """
    kind = FAULTS[order.fault]
    if kind.not_live:
        raise InputRefused("fault.not-live", f"{order.fault}: {kind.not_live}")
    time.sleep(order.at_s)
    match kind.edge:
        case Edge.PLANT:
            return _ask_plant(order, target.ports["sim"])
        case Edge.BUS:
            return _disturb_bus(order, target, consent)
        case Edge.PLANNER:
            return _as_planner(order, target)
    return _signal(order.part, order, target, off=order.fault == "process-off")


def _ask_plant(order: Order, port: int) -> str:
    request = {
        "op": "fault",
        "name": order.fault,
        "part": order.part,
        "size": str(order.sized()),
        "seed": str(order.seed),
    }
    if math.isfinite(order.length_s):
        request["for_s"] = str(order.length_s)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(ANSWER_S)
        client.sendto(json.dumps(request).encode(), (HOST, port))
        try:
            answer: Any = json.loads(client.recv(65536))
        except OSError as error:
            raise InputRefused("fault.plant-silent", f"the plant at port {port} does not answer: {error}") from None
    if "error" in answer:
        raise InputRefused("fault.plant-refuses", f"the plant refuses {order.fault}: {answer['error']}")
    return f"{order.fault} {order.part} begun in the plant"


def _disturb_bus(order: Order, target: LiveTarget, consent: bool) -> str:
    now_ns = time.monotonic_ns()
    end_ns = now_ns + round(order.length_s * 1e9) if math.isfinite(order.length_s) else FOREVER_NS
    bus, fault = wire_fault(order, target.profile, now_ns, end_ns)
    address = target.buses[bus]
    try:
        if address.startswith("wire:"):
            control(address.removeprefix("wire:"), {"inject": fault.to_json()})
            return f"{order.fault} begun on {address}"
        return _send_frames(order, address, fault, consent)
    except LinkError as error:
        raise InputRefused("fault.bus", f"{address}: {error}") from None


def _send_frames(order: Order, address: str, fault: Fault, consent: bool) -> str:
    """Send frames from a participant of our own: all that can be done to a bus of the kernel."""
    if fault.kind is not Kind.BABBLE:
        raise InputRefused(
            "fault.only-on-wire",
            f"{order.fault} needs the wire: frames on {address} cannot be lost or changed; use --bus wire",
        )
    if "vcan" not in address and not consent:
        raise InputRefused(
            "fault.real-bus",
            f"{address} may be a machine; add --i-know to send {order.fault} there, with nobody near it",
        )
    if not math.isfinite(order.length_s):
        raise InputRefused("fault.endless", f"{order.fault} on {address} needs an end; add --for")
    ends_s, sent = time.monotonic() + order.length_s, 0
    with open_bus(address, participant="fault") as bus:
        while time.monotonic() < ends_s:
            sent += bus.send(fault.key, fault.data)
            time.sleep(fault.shift_ns * 1e-9)
    return f"{order.fault}: {sent} frames sent on {address}"


def _as_planner(order: Order, target: LiveTarget) -> str:
    if order.fault == "planner-off":
        return _signal("planner", order, target, off=False)
    try:
        key = read_key(target.key_file)
    except ConfigError as error:
        raise InputRefused("fault.no-live-run", f"{error} The run has ended.") from None
    random, sent = Random(order.seed), 0
    ends_s = time.monotonic() + (order.length_s if math.isfinite(order.length_s) else 1.0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        while time.monotonic() < ends_s:
            data = _datagram(order.fault, target, random, key)
            client.sendto(data, (HOST, target.ports["control"]))
            sent += 1
            time.sleep(FLOOD_PERIOD_S)
    return f"{order.fault}: {sent} datagrams sent to the controller"


def _datagram(fault: str, target: LiveTarget, random: Random, key: bytes) -> bytes:
    code, now_ns = profile_hash(target.profile), time.monotonic_ns()
    match fault:
        case "planner-garbage":
            return random.randbytes(random.randrange(1, 900))
        case "planner-arms":
            action = random.choice((OperatorAction.ARM, OperatorAction.RESET))
            return encode(OperatorCommand(random.randrange(1 << 31), code, now_ns, action), key)
    return encode(OperatorCommand(1, code, 1, OperatorAction.ARM), key)  # the same old datagram again and again


def _signal(process: str, order: Order, target: LiveTarget, off: bool) -> str:
    name = _PROCESSES[process]
    pid = target.pids.get(name)
    if pid is None:
        raise InputRefused("fault.no-process", f"the run has no process {name}")
    try:
        if off:
            os.kill(pid, signal.SIGKILL)
            return f"{process} (process {pid}) killed"
        os.kill(pid, signal.SIGSTOP)
        if math.isfinite(order.length_s):
            time.sleep(order.length_s)
            os.kill(pid, signal.SIGCONT)
            return f"{process} (process {pid}) stopped for {order.length_s:g} s"
    except ProcessLookupError:
        raise InputRefused("fault.no-process", f"{process} (process {pid}) has ended") from None
    return f"{process} (process {pid}) stopped; kill -CONT {pid} lets it go on"
