"""The whole PLC path on virtual time, and the profile of a machine with a PLC between crane0 and its valves."""

from __future__ import annotations

import re
from pathlib import Path
from random import Random
from typing import Final, Literal

from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.plc import map as plc
from can_dbc.plc.datagram import encode_reply
from can_dbc.plc.modbus import RegisterRefused
from controller.guard.__main__ import profile_path
from controller.plc.bridge import EXCHANGE_NS, Bridge, role_of
from machine.loading.profile_file import carry_envelope
from machine.profile import Profile
from sim.plc.plant import PlcPlant

# -- The whole PLC path on virtual time with the interface of a plant: `hil.harness.lockstep` runs it as its plant.
#
# The path consists of the bridge (`controller.plc`), the wire format of either transport, and the emulated PLC
# (`sim.plc`).  Every 10 ms a command leaves as real bytes or registers; the PLC gets it one slice later, and the
# answer arrives another slice later, as on a quiet Ethernet.

Transport = Literal["modbus", "udp"]
_CLIENT: Final = 1


class BridgedPlant(PlcPlant):
    """A plant behind PLC and bridge; while ``cut`` is True, nothing passes the cable in either direction."""

    def __init__(
        self, profile: Profile, seed: int = 0, truth: str = "nominal", logs: int = 1, transport: Transport = "modbus"
    ) -> None:
        numbers = Random(f"plc session {seed}")
        super().__init__(profile, seed, truth, logs, role=role_of(profile), draw=lambda: numbers.getrandbits(32))
        self.bridge = Bridge(profile, load("crane"))
        self.cut = False
        self._transport = transport
        self._exchange_ns = 0
        self._command: list[int] | bytes | None = None
        self._answer: list[int] | bytes | None = None

    def step(self, now_ns: int, received: list[tuple[str, Frame]]) -> list[tuple[str, int, bytes]]:
        """Advance to ``now_ns`` like a plant; input and output are the bridge's frames."""
        super().step(now_ns, [])
        self._arrive(now_ns)
        crane = self.profile.crane_bus
        frames = [frame for bus, frame in received if bus == crane]
        return self.tap.pass_on(now_ns, [(crane, key, data) for key, data in self.bridge.step(now_ns, frames)])

    def _arrive(self, now_ns: int) -> None:
        """Advance one slice of the cable: the answer reaches the bridge, the command the PLC, a new command leaves."""
        answer, self._answer = self._answer, None
        command, self._command = self._command, None
        shake = self.bridge.handshake
        if self.cut:
            answer = command = None
        if isinstance(answer, list):
            shake.accept_registers(answer, now_ns)
        elif answer is not None:
            shake.accept_datagram(answer, now_ns)
        if command is not None:
            self._answer = self._serve(command, now_ns)
        if now_ns >= self._exchange_ns:
            self._exchange_ns = now_ns + EXCHANGE_NS
            next_command = self.bridge.command(now_ns)
            self._command = (
                shake.registers(next_command, now_ns)
                if self._transport == "modbus"
                else shake.datagram(next_command, now_ns)
            )

    def _serve(self, command: list[int] | bytes, now_ns: int) -> list[int] | bytes | None:
        gate, feedback = self.plc.arbiter, self.plc.feedback
        if isinstance(command, list):
            try:
                gate.write(_CLIENT, plc.COMMAND_AT, command, now_ns)
            except RegisterRefused as refused:
                self.bridge.handshake.command_refused(refused.code)
                return None
            return self.plc.status()
        offer = gate.datagram(_CLIENT, command, now_ns)
        if offer is None and not gate.session.number:
            return None
        return encode_reply(offer or gate.session.reply_header(now_ns), feedback)


# -- The profile of a machine with a PLC between crane0 and its valves.

PLC_DELAY_S: Final = 0.04
"""Delay that bridge, exchange and PLC cycle add to every valve: 10 ms each way, and two cycles between."""
_DELAY: Final = re.compile(r"^delay_s = ([0-9.]+)", re.MULTILINE)


def write_plc_profile(name: str, role: Literal["references", "valves"], directory: Path) -> Path:
    """Write ``NAME_plc.toml`` into a directory, from the name of a shipped profile or a file.

    The valve delays of the joints grow by `PLC_DELAY_S`: the controller uses them to lead its references and to monitor
    whether a joint follows its command.
    """
    text = _DELAY.sub(lambda found: f"delay_s = {float(found[1]) + PLC_DELAY_S:g}", profile_path(name).read_text())
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"{Path(name).stem}_plc.toml"
    path.write_text(f'{text}\n# The machine PLC on Ethernet\n[plc]\nrole = "{role}"\n')
    carry_envelope(profile_path(name), directory)
    return path
