"""Acceptance of operator commands to the mission, by the same rules as the controller's operator commands.

A command is accepted when its checksum (and, with a key, its authentication) is right, when it is for this machine, at
most ``MAX_AGE_NS`` old and newer than the last one.  Commands come from this computer only: the port is bound to
loopback, and the stamp of another computer's clock has no meaningful age here.
"""

from __future__ import annotations

from typing import Final

from can_dbc.messages.envelope import DatagramRefused, Kind, kind_of
from can_dbc.messages.mission import MissionCommand, MissionUpload, decode_mission_command, decode_mission_upload
from runtime.errors import TimberhandError

MAX_AGE_NS: Final = 1_000_000_000


class CommandRefused(TimberhandError, ValueError):
    """An operator command is not accepted; the message says why."""


class CommandReceiver:
    """Accepts or refuses commands; it remembers the last accepted one."""

    def __init__(self, profile_hash: int, key: bytes | None = None) -> None:
        self._hash, self._key = profile_hash, key
        self._last = (-1, -1)

    def accept(self, data: bytes, now_ns: int) -> MissionCommand | MissionUpload:
        """Return the command or upload in a datagram.

        Raises:
            CommandRefused: it is not accepted and must not be executed.
        """
        try:
            decode = decode_mission_upload if kind_of(data) == Kind.UPLOAD else decode_mission_command
            command: MissionCommand | MissionUpload = decode(data, self._key)
        except DatagramRefused as error:
            raise CommandRefused("command.datagram", str(error)) from None
        if command.profile_hash != self._hash:
            raise CommandRefused("command.other-profile", "it is for a machine with another profile")
        if command.stamp_ns > now_ns:
            raise CommandRefused("command.future", "its stamp lies in the future")
        if now_ns - command.stamp_ns > MAX_AGE_NS:
            raise CommandRefused("command.too-old", f"it is {(now_ns - command.stamp_ns) * 1e-9:.1f} s old")
        if (command.stamp_ns, command.sequence) <= self._last:
            raise CommandRefused("command.repeated", "it was sent before, or a later one was")
        self._last = (command.stamp_ns, command.sequence)
        return command
