"""The naive control loop: ``python -m experiments.timing.sleep_loop --period-us 5000 --seconds 10``.

It calls ``time.sleep`` until the next deadline at normal priority and does no work.  A period that has passed when it
wakes is missed and skipped.  At the end it prints one JSON object: the bins of its lateness and the missed periods.
"""

from __future__ import annotations

import argparse
import json
import time

from can_dbc.timing.durations import Durations


def run(period_ns: int, seconds: float) -> tuple[Durations, int]:
    """Lateness of every wake-up, and the periods skipped."""
    lateness, missed = Durations(), 0
    deadline_ns = time.monotonic_ns() + period_ns
    end_ns = deadline_ns + round(seconds * 1e9)
    while deadline_ns < end_ns:
        time.sleep(max(0, deadline_ns - time.monotonic_ns()) * 1e-9)
        late_ns = time.monotonic_ns() - deadline_ns
        lateness.add(late_ns)
        skipped = late_ns // period_ns
        missed += skipped
        deadline_ns += (1 + skipped) * period_ns
    return lateness, missed


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.timing.sleep_loop")
    parser.add_argument("--period-us", type=int, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    options = parser.parse_args()
    lateness, missed = run(1000 * options.period_us, options.seconds)
    bins = {str(i): n for i, n in enumerate(lateness.bins) if n}
    print(json.dumps({"bins": bins, "longest_ns": lateness.longest_ns, "missed": missed}), flush=True)


if __name__ == "__main__":
    main()
