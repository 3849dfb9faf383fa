"""The loop: deadlines, skipped periods, datagrams, records, warm-up; with a bus in memory and a scripted clock."""

from controller.process.realtime import make_sleep, sleep_until
from tests.controller.bench import MS


def test_sleep_until_returns_for_the_past_and_reaches_the_future():
    import time

    sleep_until(0)
    for sleep in (sleep_until, make_sleep(0), make_sleep(200_000)):
        until_ns = time.monotonic_ns() + 3 * MS
        sleep(until_ns)
        assert time.monotonic_ns() >= until_ns
    assert make_sleep(0) is sleep_until
