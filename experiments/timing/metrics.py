"""Metrics of the timing experiment with their limits, and the page that shows them."""

from __future__ import annotations

from typing import Final

from experiments.common.result import Metric
from experiments.common.result_page import Section

MAX_MISSED_SHARE: Final = 0.01
"""Limit for our missed deadlines under load, as a share of the sleep loop's."""

CONCLUSION: Final = (
    "A tick of the controller takes {tick_cpu_p50_us} of CPU time in the median and {tick_cpu_p99_us} at the 99th "
    "percentile; the controller uses {cpu_share} of one processor at 200 Hz.",
    "Its wake-ups are late by {wakeup_p50_us} in the median, those of cyclictest by {cyclictest_p50_us}.",
    "With every core loaded it missed {missed_loaded} deadlines, cyclictest {missed_loaded_cyclictest} and the sleep "
    "loop {missed_loaded_plain}.",
)
INTRODUCTION: Final = (
    "The measured controller is the process that runs on the machine: `python -m controller` with SCHED_FIFO and "
    "locked memory, beside the real guard, on the wire bus. Every CAN node of the machine is emulated, on joints that "
    "follow their valves, so that the processors are free for what is measured."
)

LOOPS: Final = {"wakeup": "Controller", "cyclictest": "cyclictest", "plain": "Sleep loop"}
QUANTILES: Final = {"p50": "median", "p99": "p99", "p999": "p99.9", "max": "longest"}


def _lateness(mark: str, where: str, *keys: str) -> tuple[Metric, ...]:
    """Quantiles of the lateness of the three loops; ``mark`` follows the names of the loops."""
    how = "From the deadline to the first reading of the clock, in the loop's own histogram."
    return tuple(
        Metric(f"{loop}{mark}_{key}_us", f"{title}{where}: lateness, {QUANTILES[key]}", "us", how)
        for key in keys or QUANTILES
        for loop, title in LOOPS.items()
    )


def _missed(end: str, where: str) -> tuple[Metric, ...]:
    """Deadlines that each loop missed under load."""
    loops = {"": "controller", "_cyclictest": "cyclictest", "_plain": "sleep loop"}
    how = "Periods skipped, or by which a wake-up of cyclictest was late."
    return tuple(
        Metric(f"missed_loaded{loop}{end}", f"Deadlines missed{where}: {title}", "", how)
        for loop, title in loops.items()
    )


_LOST = "Frames refused by a bus or lost before they were read"
_INTERPRETER = "Kept recordings, both in turn (`timberhand bench tick`), the smaller ratio of the two machines."
OWN: Final = Section(
    "Cost of the controller",
    "Page faults, garbage collection and system calls do not depend on the host's noise, so their limits hold on any "
    "host. CPU time does: other work replaces the tick's data in the caches, and what the hypervisor takes in the "
    "middle of a tick counts as the tick's. It is therefore judged in the quietest quarter of the windows, chosen by "
    "the processor time of the sleep loop alone, and a missed limit is *inconclusive* if cyclictest was late even in "
    "these. Three figures see a regression on any host: the tick's median in cycles of the sleep loop, which does the "
    "same each time on the same processor in the same seconds, the instructions of a tick, where the host counts "
    "them, and the ratios of interpreter and compiled tick, measured in turn. A lost frame or a stop counts against "
    "the controller unless a witness, a process with nothing to do and the highest priority of its processor, saw "
    "that processor stand still just before. The whole forwarder is on both buses and moves with every control law "
    "active; reports and a record of every tick leave the process as on the machine.",
    (
        Metric("tick_cpu_p50_us", "CPU time of a tick, median", "us", "The thread's own clock, 200 Hz.", most=150.0),
        Metric("tick_cpu_p99_us", "CPU time of a tick, p99", "us", "The limit is 6 % of the period.", most=300.0),
        Metric("tick_cpu_all_p50_us", "CPU time of a tick in all windows, median", "us", "Noisy windows included."),
        Metric("tick_cpu_all_p99_us", "CPU time of a tick in all windows, p99", "us", "Noisy windows included."),
        Metric("tick_cpu_in_plain", "CPU time of a tick in cycles of the sleep loop", "x", "Median of all windows."),
        Metric("plain_cpu_us", "CPU time of a cycle of the sleep loop, quietest windows", "us", "The host's speed."),
        Metric("plain_cpu_all_us", "CPU time of a cycle of the sleep loop, all windows", "us", "Their median."),
        Metric("tick_p50_us", "Tick by the wall clock, median", "us", "From its first to its last stage."),
        Metric("tick_p99_us", "Tick by the wall clock, p99", "us", "As for the median."),
        Metric("tick_cpu_max_us", "CPU time of a tick, longest", "us", "Quietest windows."),
        Metric("tick_instructions", "Instructions of the controller per tick", "", "perf_event_open(2), with waits."),
        Metric("compiled_ratio_cold", "Interpreter over compiled tick, cold caches", "x", _INTERPRETER, least=2.0),
        Metric("compiled_ratio_hot", "Interpreter over compiled tick, hot caches", "x", _INTERPRETER, least=2.0),
        Metric(
            "tick1k_cpu_p99_us",
            "CPU time of a tick at 1 kHz, fixed crane, p99",
            "us",
            "The limit is 25 % of the period; quietest windows. The wire bus runs at 4 Mbit/s: ten frames of 8 "
            "bytes per millisecond do not fit on a CAN bus of 1 Mbit/s.",
            most=250.0,
        ),
        Metric("cpu_share", "CPU load of the controller at 200 Hz", "%", "getrusage, quiet windows."),
        Metric("frames_per_s", "Frames received and sent, both buses", "1/s", "The controller's own counters."),
        Metric("frames_lost", _LOST, "", "The controller's own counters, whole measurement.", most=0.0),
        Metric(
            "frames_lost_unexplained",
            "Lost frames without a stall of the host",
            "",
            "No witness saw a stall before that is long enough to fill the transmit queue, or of 25 ms.",
            most=0.0,
        ),
        Metric("machine_frames_lost", "Frames lost by the emulated machine", "", "Its own counters."),
        Metric("records_lost", "Tick records lost on the way to the observer", "", "By their nominal times."),
        Metric("stalls", "Stalls of a processor that a witness saw", "", "3 ms or longer, whole measurement."),
        Metric("stall_max_ms", "Longest of them", "ms", "By the witness's own lateness."),
        Metric("page_faults", "Page faults", "", "Minor and major, all quiet windows.", most=0.0),
        Metric("gc_runs", "Runs of the garbage collector", "", "All quiet windows.", most=0.0),
        Metric(
            "allocated_blocks_growth",
            "Growth of allocated memory blocks",
            "",
            "Blocks of the interpreter: minimum of the second half of the windows less minimum of the first half.",
            most=0.0,
        ),
        Metric("resident_growth_kb", "Growth of resident memory", "kB", "First to last reading.", most=0.0),
        Metric("syscalls_per_tick", "System calls per tick", "", "By strace, after the measurement.", most=60.0),
        Metric(
            "voluntary_switches_per_tick",
            "Voluntary context switches per tick",
            "",
            "One wait for SYNC and one for the tick.",
            most=2.05,
        ),
        Metric(
            "involuntary_switches_per_tick",
            "Involuntary context switches per tick",
            "",
            "Caused by a process of higher priority or by the kernel.",
        ),
    ),
    (("stages.png", "Duration of the stages of a tick: median, p99 and longest (log scale)."),),
)
_BOOTSTRAP = "Interpolated inside the bins of 1 us; interval by bootstrap over the windows."
WAKEUPS: Final = Section(
    "Wake-ups compared with cyclictest",
    "The lateness of a wake-up depends more on the host than on the controller. Therefore cyclictest (rt-tests, in C, "
    "without work) wakes at the controller's priority on its core during the same seconds, 0.8 of a period after the "
    "tick, and a `time.sleep` loop of normal priority runs beside it. Only windows in which cyclictest shows a quiet "
    "host are compared: its longest lateness is at most a fifth of the period, its p99 at most a twentieth, and steal "
    "at most 0.5 %. If fewer than half of the windows are quiet, the host is too noisy, and these metrics are "
    "*inconclusive* whatever their values.",
    (
        Metric("host_verdict", "Host quiet enough (1 yes, 0 no)", "", "The rule above."),
        Metric("quiet_windows", "Quiet windows", "", "The rule above."),
        Metric("windows", "All windows", "", "Quiet and noisy ones."),
        *_lateness("", ""),
        Metric("wakeup_p50_ratio", "Ratio of the medians, controller over cyclictest", "x", _BOOTSTRAP, most=1.5),
        Metric("wakeup_p99_ratio", "Ratio of the p99", "x", _BOOTSTRAP, most=2.0),
        Metric("judged_cycles", "Cycles compared", "", "Ticks of the controller in the windows that are compared."),
        Metric("missed", "Deadlines missed in these cycles", "", "The limit is zero in 100,000 cycles.", most=0.0),
        Metric("steal_ms", "Time taken by the hypervisor", "ms", "/proc/stat, all processors, all windows."),
        Metric("pressure", "Share of time in which a process waited for a processor", "%", "/proc/pressure/cpu."),
    ),
    (("wakeups.png", "Lateness of wake-ups on a quiet host and with every core loaded; dashed: one period."),),
)
LOADED: Final = Section(
    "Wake-ups with every core loaded",
    "stress-ng keeps every core and the memory busy. The sleep loop runs during the same seconds on the same core and "
    "in the same session, like a script started from the terminal of the load.",
    (
        *_lateness("_loaded", "", "p50", "p99"),
        *_missed("", ""),
        Metric(
            "missed_loaded_share", "Deadlines missed, controller over sleep loop", "%", "200 Hz.", most=MAX_MISSED_SHARE
        ),
        *_lateness("1k", " at 1 kHz, quiet", "p99"),
        Metric("missed_1k", "Deadlines missed by the controller at 1 kHz, quiet", "", "Fixed crane."),
        *_missed("_1k", " at 1 kHz"),
        Metric(
            "stops",
            "Stops of the machine in the whole measurement",
            "",
            "The supervisor stops a machine whose inputs or loop are late.",
            most=0.0,
        ),
        Metric(
            "stops_unexplained",
            "Stops without a stall of the host",
            "",
            "No witness saw a stall of 10 ms or more in the 0.45 s before.",
            most=0.0,
        ),
    ),
)
LATENCY: Final = Section(
    "From sample to command",
    "The encoders sample on SYNC; the tick that uses the samples sends the valve command. The wire bus gives every "
    "frame its transmission time.",
    (
        Metric(
            "sample_to_command_p50_us",
            "From the encoders' sample to the valve command, median",
            "us",
            "From the time stamp of SYNC on the wire bus to the command passed to the bus, 200 Hz, quiet windows.",
        ),
        Metric(
            "sample_to_command_p99_us",
            "From the encoders' sample to the valve command, p99",
            "us",
            "The limit is one period.",
            most=5000.0,
            clocked=True,
        ),
        Metric(
            "rx_decode_us",
            "Receiving and decoding one frame, raw socket",
            "us",
            "On this host, per frame.",
            most=5.0,
            clocked=True,
        ),
        Metric("rx_decode_pythoncan_us", "Receiving and decoding one frame, python-can", "us", "The same frames."),
    ),
    (("ages.png", "Age of every input when a tick used it: newest and longest."),),
)
SECTIONS: Final = (OWN, WAKEUPS, LOADED, LATENCY)
METRICS: Final = tuple(m for section in SECTIONS for m in section.metrics)
