"""The timing page of the controller: read completely or not at all; and the histograms on it."""

import os
import stat
import struct
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.timing.durations import BINS, Durations, bin_of, edge_ns
from can_dbc.timing.page import STAGES, Timing, TimingWriter, default_path, read_timing
from runtime.errors import InputRefused
from tests.codes import coded
from tests.conftest import a_timing


def publish(writer: TimingWriter, page: Timing) -> Timing:
    writer.publish(page.facts, page.durations)
    return page


@pytest.fixture(autouse=True)
def _at_once(monkeypatch):
    """A reader tries again at once."""
    monkeypatch.setattr("time.sleep", lambda _seconds: None)


def test_a_written_page_is_read(tmp_path):
    path = tmp_path / "sub" / "controller.timing"
    writer = TimingWriter(path)
    with pytest.raises(InputRefused, check=coded("timing.not-written")):
        read_timing(path)
    page = publish(writer, a_timing())
    found = read_timing(path)
    assert found.facts == page.facts
    assert [found.durations[name].quantile_ns(1.0) > 0 for name in STAGES[1:]] == [True] * (len(STAGES) - 1)
    assert found.durations["sync"].bins == page.durations["sync"].bins
    writer.close()
    writer.close()
    with pytest.raises(InputRefused, check=coded("timing.no-page")):
        read_timing(path)


def test_every_user_may_read_it_with_any_umask(tmp_path):
    before = os.umask(0o077)
    try:
        writer = TimingWriter(tmp_path / "page")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "page").stat().st_mode) == 0o644
    writer.close()


def test_a_page_during_a_write_or_of_another_release_is_refused(tmp_path):
    path = tmp_path / "page"
    writer = TimingWriter(path)
    publish(writer, a_timing())
    with path.open("r+b") as file:
        file.seek(8)
        file.write(struct.pack("<Q", 3))
    with pytest.raises(InputRefused, check=coded("timing.not-written")):
        read_timing(path)
    with path.open("r+b") as file:
        file.write(struct.pack("<II", 0x504D4854, 99))
    with pytest.raises(InputRefused, check=coded("timing.other-release")):
        read_timing(path)
    path.write_bytes(b"short")
    with pytest.raises(InputRefused):
        read_timing(path)


def test_a_reader_never_sees_a_mixture(tmp_path):
    """While the writer writes continuously, every copy is of a single state."""
    path = tmp_path / "page"
    writer = TimingWriter(path)
    states = [a_timing(k, words=f"{k} " * 100 * k) for k in (1, 5, 9)]
    publish(writer, states[0])
    ended = threading.Event()

    def write() -> None:
        while not ended.is_set():
            for state in states:
                publish(writer, state)
                ended.wait(0.0005)

    thread = threading.Thread(target=write)
    thread.start()
    try:
        for _ in range(100):
            found = read_timing(path)
            ticks = found.facts.ticks
            assert found.facts.words == f"{ticks} " * 100 * ticks
            assert {found.durations[name].count for name in STAGES} == {ticks}
    finally:
        ended.set()
        thread.join()


def test_a_second_controller_replaces_the_page_and_the_first_keeps_off_it(tmp_path):
    path = tmp_path / "page"
    first, second = TimingWriter(path), TimingWriter(path)
    publish(second, a_timing(7))
    publish(first, a_timing(1))
    first.close()
    assert read_timing(path).facts.ticks == 7
    second.close()
    assert not path.exists()


def test_facts_that_do_not_fit_keep_the_former_page(tmp_path):
    path = tmp_path / "page"
    writer = TimingWriter(path)
    page = publish(writer, a_timing())
    publish(writer, a_timing(words="x" * 20_000))
    assert read_timing(path).facts.words == page.facts.words


def test_the_path_is_that_of_the_service_or_the_user(monkeypatch):
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/timberhand:/run/other")
    assert str(default_path()) == "/run/timberhand/controller.timing"
    monkeypatch.delenv("RUNTIME_DIRECTORY")
    assert str(default_path()) == f"/dev/shm/timberhand-{os.getuid()}/controller.timing"


def test_a_page_with_missing_stages_is_refused(tmp_path):
    path = tmp_path / "timing"
    writer = TimingWriter(path)
    publish(writer, a_timing(longest_ns=(1, 2)))
    with pytest.raises(InputRefused):
        read_timing(path)
    writer.close()


# -- histograms: bins, quantiles, differences

US, MS = 1_000, 1_000_000
ANY = st.one_of(st.integers(-1000, 2 * MS), st.integers(0, 200 * MS))


def width_ns(duration_ns: int) -> int:
    return US if duration_ns < MS else 10 * US if duration_ns < 10 * MS else 100 * US


@given(ANY)
def test_a_duration_lies_between_the_edges_of_its_bin(duration_ns):
    i = bin_of(duration_ns)
    assert 0 <= i < BINS
    if i < BINS - 1:
        assert max(duration_ns, 0) < edge_ns(i) <= max(duration_ns, 0) + width_ns(duration_ns)
        assert i == 0 or edge_ns(i - 1) <= duration_ns


@given(st.lists(ANY, min_size=1, max_size=200), st.floats(0.01, 1.0))
def test_quantiles_are_within_a_bin_of_the_true_ones(durations, share):
    made = Durations()
    for duration_ns in durations:
        made.add(duration_ns)
    assert made.count == len(durations) and made.total_ns == sum(durations)
    ordered = sorted(max(d, 0) for d in durations)
    true_ns = next(d for k, d in enumerate(ordered, 1) if k >= share * len(ordered))
    if true_ns < 100 * MS:
        assert abs(made.quantile_ns(share) - true_ns) <= width_ns(true_ns)


def test_an_empty_histogram_has_quantile_zero_and_the_last_bin_the_longest():
    made = Durations()
    assert made.quantile_ns(0.99) == 0
    assert made.summary() == {"p50_us": 0, "p99_us": 0, "p999_us": 0, "max_us": 0, "count": 0}
    made.add(700 * MS)
    assert made.quantile_ns(0.5) == 700 * MS


def test_a_difference_has_the_later_durations():
    early = Durations()
    for duration_ns in (5 * US, 900 * MS):
        early.add(duration_ns)
    now = Durations(early.bins.tobytes(), early.longest_ns, early.total_ns)
    for duration_ns in (7 * US, 7 * US, 40 * US):
        now.add(duration_ns)
    late = now - early
    assert late.count == 3 and late.total_ns == 54 * US
    assert late.longest_ns == 41 * US, "the edge of the bin: the former longest is not of this time"
    assert (now - now).longest_ns == 0


def test_over_counts_durations_beyond_a_limit():
    made = Durations()
    for duration_ns in (1 * MS, 10 * MS + 1, 50 * MS, 300 * MS):
        made.add(duration_ns)
    assert made.over(10 * MS + 50 * US) == 2


def test_periods_are_those_that_a_late_loop_skips():
    made = Durations()
    for duration_ns in (4 * MS, 5 * MS + 1, 14 * MS, 20 * MS + 50 * US, 1 * MS):
        made.add(duration_ns)
    assert made.periods(5 * MS) == 0 + 1 + 2 + 4 + 0
    made.add(203 * MS)
    assert made.periods(5 * MS) == 7 + 40
