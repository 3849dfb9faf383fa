"""The naive control loop: ``python -m experiments.timing.sleep_loop --period-us 5000 --seconds 10``.

It calls ``time.sleep`` until the next deadline at normal priority and does no work.  A period that has passed when it
wakes is missed and skipped.  At the end it prints one JSON object: the bins of its lateness, the missed periods, and
the processor time of one cycle.  It does the same in every cycle, so that time shows how fast the host runs a thread
that finds its caches as the others left them.
"""

from __future__ import annotations

import argparse
import json
import time

from can_dbc.timing.durations import Durations


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.timing.sleep_loop")
    parser.add_argument("--period-us", type=int, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    options = parser.parse_args()
    period_ns, lateness, missed = 1000 * options.period_us, Durations(), 0
    begin_ns, deadline_ns = time.thread_time_ns(), time.monotonic_ns() + period_ns
    end_ns = deadline_ns + round(options.seconds * 1e9)
    while deadline_ns < end_ns:
        time.sleep(max(0, deadline_ns - time.monotonic_ns()) * 1e-9)
        late_ns = time.monotonic_ns() - deadline_ns
        lateness.add(late_ns)
        skipped = late_ns // period_ns
        missed += skipped
        deadline_ns += (1 + skipped) * period_ns
    cpu_us = (time.thread_time_ns() - begin_ns) / 1e3 / max(1, lateness.count)
    bins = {str(i): n for i, n in enumerate(lateness.bins) if n}
    summary = {"bins": bins, "longest_ns": lateness.longest_ns, "missed": missed, "cpu_us": round(cpu_us, 3)}
    print(json.dumps(summary), flush=True)


if __name__ == "__main__":
    main()
