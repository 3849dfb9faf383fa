"""``python -m hil.faults``: the desk at which the page of a live run orders faults (`hil.faults.desk`)."""

from __future__ import annotations

import argparse
import json
import signal
import sys
from pathlib import Path

from hil.faults.desk import Desk


def main() -> int:
    """Serve until SIGINT or SIGTERM."""
    parser = argparse.ArgumentParser(prog="python -m hil.faults", description="Faults for the page of a live run.")
    parser.add_argument("--run", type=Path, required=True, metavar="DIR", help="directory of the live run")
    parser.add_argument("--socket", type=Path, required=True, metavar="FILE", help="socket to serve at")
    a = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGINT))
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
