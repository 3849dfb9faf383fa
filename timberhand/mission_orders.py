"""Orders to a planner that runs on this computer: offer it a mission, set it to Auto, pause or abort it.

They go to the planner's order port on the loopback interface, authenticated with the key of the installation, which
root and the group timberhand-operator may read.  The planner answers each accepted order with a mission report.
"""

from __future__ import annotations

import hashlib
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, monotonic_ns
from typing import Final

from autonomy.missions import geojson
from autonomy.missions.folder import MissionFolder
from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import ForwardingMission, MissionError
from autonomy.missions.review import review
from can_dbc.messages.envelope import SERVICE_KEY, DatagramRefused, read_key
from can_dbc.messages.mission import (
    MissionAction,
    MissionCommand,
    MissionReport,
    MissionUpload,
    decode_mission,
    encode_mission_command,
    encode_mission_upload,
)
from host.exit_codes import CommandFailed, ExitCode
from machine.profile import Profile

ANSWER_S: Final = 3.0
"""The planner answers at once, but plans a path while it does."""
MAX_REPORT_BYTES: Final = 65535
_SEQUENCES: Final = 0x7FFF_FFFF


def exchange(port: int, order: bytes) -> Iterator[bytes]:
    """Send an order to a port of this computer; yields the datagrams that come back, until it takes too long.

    Raises:
        OSError: nobody listens there.
    """
    deadline_s = monotonic() + ANSWER_S
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.connect(("127.0.0.1", port))
        link.send(order)
        while (left_s := deadline_s - monotonic()) > 0.0:
            link.settimeout(left_s)
            try:
                yield link.recv(MAX_REPORT_BYTES)
            except TimeoutError:
                return


def key_of(file: Path | None) -> bytes | None:
    """Read the key in ``file``; by default that of the installed services, None where there is none.

    Raises:
        ConfigError: it cannot be read.
    """
    if file is None and not SERVICE_KEY.exists():
        return None
    return read_key(file or SERVICE_KEY)


def checked(file: Path, machine: Profile) -> ForwardingMission:
    """Return the mission of a file after the checks of ``timberhand plan check``.

    Raises:
        MissionError: it cannot be driven.
    """
    carrier = machine.carrier
    if carrier is None:
        raise MissionError(
            "mission.stationary-machine",
            f"{machine.name} does not drive; name the profile of the machine with --profile",
        )
    mission = load_mission(file, route_wanted=True, site=(carrier.site_lat_deg, carrier.site_lon_deg)).mission
    review(mission, machine)
    return mission


@dataclass(frozen=True, slots=True)
class PlannerOrders:
    """Orders to the planner of a machine at ``port``; ``key`` None: it authenticates nothing."""

    port: int
    profile_hash: int
    key: bytes | None

    def start(self, mission: ForwardingMission, name: str, folder: Path) -> MissionReport:
        """Save a checked mission as ``name`` in the planner's folder, offer it, and set it to Auto.

        Raises:
            CommandFailed: it cannot be saved, or the planner refuses or does not answer.
        """
        data = geojson.write(mission)
        try:
            MissionFolder(folder).write(name, data, replace=True)
        except MissionError as error:
            raise CommandFailed(error.code, f"{folder}: {error}; the services' folder is written by root") from None
        digest = hashlib.sha256(data).digest()
        self._ask(
            lambda number, now_ns: encode_mission_upload(
                MissionUpload(number, self.profile_hash, now_ns, name, digest), self.key
            )
        )
        return self.order(MissionAction.AUTO)

    def order(self, action: MissionAction) -> MissionReport:
        """Send an order; return the mission's report after it.

        Raises:
            CommandFailed: the planner refuses or does not answer.
        """
        return self._ask(
            lambda number, now_ns: encode_mission_command(
                MissionCommand(number, self.profile_hash, now_ns, action), self.key
            )
        )

    def _ask(self, datagram: Callable[[int, int], bytes]) -> MissionReport:
        now_ns = monotonic_ns()
        number = now_ns // 1_000_000 & _SEQUENCES
        try:
            for data in exchange(self.port, datagram(number, now_ns)):
                try:
                    code, _, report = decode_mission(data, self.key)
                except DatagramRefused:
                    continue
                if code != self.profile_hash or report.order != number:
                    continue
                if report.refusal:
                    raise CommandFailed(
                        report.refusal_code or "mission.refused",
                        f"the planner refuses: {report.refusal}",
                        ExitCode.SAFETY_STOP,
                    )
                return report
        except OSError as error:
            raise CommandFailed(
                "mission.no-planner",
                f"no planner listens at port {self.port} ({error.strerror}); start it with --order-port {self.port}",
                ExitCode.BUS,
            ) from None
        raise CommandFailed(
            "mission.no-answer",
            f"the planner at port {self.port} does not answer; it needs --missions, this --profile and this key",
            ExitCode.BUS,
        )
