"""The MCAP writer: byte for byte the output of the library's writer."""

from __future__ import annotations

from io import BytesIO

from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from recorder.segment import McapFile

TOPICS = ("/crane0/raw", "/crane0/ValveCmd", "/manifest")
TIMES = st.integers(0, 2**40)
MESSAGES = st.lists(st.tuples(st.integers(0, len(TOPICS) - 1), TIMES, TIMES, st.binary(max_size=40)), max_size=12)


def written(chunks) -> tuple[bytes, bytes]:
    """The file by this writer and by the library's."""
    files = []
    for ours in (True, False):
        stream = BytesIO()
        writer = McapFile(stream, "timberhand") if ours else Writer(stream, chunk_size=1 << 30)
        if not ours:
            writer.start(library="timberhand")
        schema = writer.register_schema("Valve", "jsonschema", b"{}")
        channels = [writer.register_channel(t, "json", schema if i == 1 else 0) for i, t in enumerate(TOPICS)]
        for messages in chunks:
            for which, log_ns, publish_ns, data in messages:
                writer.add_message(channels[which], log_ns, data, publish_ns)
            writer.flush()
        writer.finish()
        files.append(stream.getvalue())
    return files[0], files[1]


@settings(deadline=None, max_examples=30)
@given(st.lists(MESSAGES, max_size=4))
def test_the_bytes_are_those_of_the_library(chunks):
    ours, theirs = written(chunks)
    assert ours == theirs


def test_the_library_reads_it_by_its_index():
    ours, _ = written([[(0, 5, 6, b"a"), (1, 3, 4, b"{}")], [], [(2, 9, 9, b"z")]])
    reader = make_reader(BytesIO(ours))
    assert [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages()] == [
        ("/crane0/ValveCmd", 3, b"{}"), ("/crane0/raw", 5, b"a"), ("/manifest", 9, b"z"),
    ]  # fmt: skip
    assert reader.get_summary().statistics.message_count == 3
