"""The datagram from console to planner that offers a mission: the name and SHA-256 of a file that both can read.

It travels as a mission command does (`can_dbc.messages.mission`), in the same envelope and to the same port.  The file
itself is in a folder that both processes know, so a mission of any size fits, and with a key the digest authenticates
it.  The planner's next mission report has the upload's sequence number in ``order`` and why it is refused in
``refusal`` and ``refusal_code``, and also goes to the sender.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from can_dbc.messages.envelope import DatagramFault, DatagramRefused, Kind, sealed, unsealed

DIGEST_BYTES: Final = 32
FILE_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9 _.-]{0,59}\.geojson")
"""Names of missions in the folder: no separators, no leading dot."""


@dataclass(frozen=True, slots=True)
class MissionUpload:
    """An offered mission: its file's name, and the SHA-256 of its bytes."""

    sequence: int
    profile_hash: int
    stamp_ns: int
    name: str
    digest: bytes


def encode_mission_upload(upload: MissionUpload, key: bytes | None = None) -> bytes:
    """The bytes of an upload."""
    common = (upload.sequence, upload.profile_hash, upload.stamp_ns)
    return sealed(Kind.UPLOAD, common, upload.digest + upload.name.encode(), key)


def decode_mission_upload(data: bytes, key: bytes | None = None) -> MissionUpload:
    """The upload in a datagram.

    Raises:
        DatagramRefused: it is not a valid upload.
    """
    kind, common, body = unsealed(data, key)
    if kind != Kind.UPLOAD:
        raise DatagramRefused(DatagramFault.KIND)
    name = body[DIGEST_BYTES:].decode(errors="replace")
    if not FILE_NAME.fullmatch(name):
        raise DatagramRefused(DatagramFault.VALUE)
    return MissionUpload(*common, name, body[:DIGEST_BYTES])
