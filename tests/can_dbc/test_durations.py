"""Histograms of durations: bins, quantiles, differences."""

from hypothesis import given
from hypothesis import strategies as st

from can_dbc.timing.durations import BINS, Durations, bin_of, edge_ns

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
