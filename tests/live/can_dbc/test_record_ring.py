"""The ring of tick records: order, wrap-around, a slow reader, a restarted writer, two processes at once."""

import os
import select
import subprocess
import sys

from can_dbc.messages.record_ring import RingReader


def test_two_processes_at_full_speed_agree_on_every_record_that_arrives(tmp_path):
    """The writer overtakes the reader again and again; what is read is whole, in order, and the rest is counted."""
    path = tmp_path / "ticks"
    script = (
        "import sys\nfrom pathlib import Path\nfrom can_dbc.messages.record_ring import RecordRing\n"
        "ring = RecordRing(Path(sys.argv[1]))\nprint('ready', flush=True)\nsys.stdin.readline()\n"
        "for k in range(200_000):\n    ring.append(k.to_bytes(4, 'little') * (1 + k % 200))\n"
        "print('done', flush=True)\nsys.stdin.readline()\nring.append(b'last')\n"
        "print('ended', flush=True)\nsys.stdin.readline()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script, path],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    ) as writer:
        assert "ready" in writer.stdout.readline()
        reader = RingReader(path)
        writer.stdin.write("\n")
        writer.stdin.flush()
        numbers = []

        def read():
            for record in reader.read():
                k = int.from_bytes(record[:4], "little")
                assert record in (b"last", k.to_bytes(4, "little") * (1 + k % 200))
                numbers.append(k if record != b"last" else 200_000)

        while not select.select([writer.stdout], [], [], 0.0)[0]:
            read()
        read()  # nothing may come for a while: the last record follows then
        for line in ("done", "ended"):
            assert line in writer.stdout.readline()
            read()
            writer.stdin.write("\n")
            writer.stdin.flush()
    assert numbers[-1] == 200_000
    assert numbers == sorted(set(numbers))
    assert len(numbers) + reader.lost == 200_001
    reader.close()
