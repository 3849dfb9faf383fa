"""Let a kept recording name the databases of now: ``python -m hil.replay.rename_databases FILE.mcap.xz ...``

Replay refuses a recording whose DBC files have changed.  Where a change only adds messages, or signals in bits that
were 0 and mean the same as before, every recorded frame means what it meant: this command writes the new hashes into
the manifest and leaves everything else as it is, and the test that replays the recording to the same bytes says whether
that was true.  Exit code 0.
"""

from __future__ import annotations

import hashlib
import io
import json
import lzma
import sys
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer

from can_dbc.dbc.codec import resolve

MANIFEST_TOPIC = "/manifest"


def renamed(recording: bytes) -> bytes:
    """A recording (MCAP) with the hashes of today's databases."""
    out = io.BytesIO()
    writer = Writer(out)
    writer.start(library="timberhand")
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    for schema, channel, message in make_reader(io.BytesIO(recording)).iter_messages(log_time_order=False):
        if channel.id not in channels:
            if schema is not None and schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            of = schemas[schema.id] if schema is not None else 0
            channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, of)
        data = message.data
        if channel.topic == MANIFEST_TOPIC:
            manifest = json.loads(data)
            for name in manifest["dbc_hash"]:
                manifest["dbc_hash"][name] = hashlib.sha256(resolve(name).read_bytes()).hexdigest()
            data = json.dumps(manifest).encode()
        writer.add_message(
            channels[channel.id], message.log_time, data, message.publish_time, sequence=message.sequence
        )
    writer.finish()  # type: ignore[no-untyped-call]
    return out.getvalue()


def main(names: list[str]) -> int:
    """Rewrite the files in place."""
    for path in map(Path, names):
        path.write_bytes(lzma.compress(renamed(lzma.decompress(path.read_bytes())), preset=9))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
