"""What the timing experiment reports: figures, limits, how each is measured, and the sections of docs/timing.md."""

from __future__ import annotations

from typing import Final

from experiments.common.result import Figure
from experiments.common.result_page import Section

SHARE_OF_PLAIN: Final = 0.01
"""Missed deadlines under load, at most this share of the plain loop's."""


OURS: Final = Section(
    "What is ours",
    "Own processor time, faults, garbage, system calls: the host's noise reaches these little or not at all, so they "
    "are judged on any host. The whole forwarder is on both buses and moves, with every law at work; reports and a "
    "record of every tick leave the process as on the machine.",
    (
        Figure("tick_cpu_p50_us", "Processor time of a tick, median", "us",
               "The thread's own clock (CLOCK_THREAD_CPUTIME_ID) around the tick, 200 Hz, quiet windows."),
        Figure("tick_cpu_p99_us", "The same, p99", "us", "10 % of the period is the limit.", most=500.0),
        Figure("tick_cpu_max_us", "The same, longest", "us", "Of all ticks."),
        Figure("tick1k_cpu_p99_us", "Processor time of a tick at 1 kHz, fixed crane, p99", "us",
               "50 % of the period is the limit. The wire runs at 4 Mbit/s: ten frames of 8 bytes in a millisecond do "
               "not fit on a CAN bus of 1 Mbit/s.", most=500.0),
        Figure("cpu_share", "Share of a processor that the controller uses at 200 Hz", "%",
               "getrusage over all quiet windows.", scale=100.0),
        Figure("frames_per_s", "Frames received and sent, both buses", "1/s", "The controller's own counters."),
        Figure("frames_lost", "Frames refused by a bus or lost before they were read", "", "The same.", most=0.0),
        Figure("page_faults", "Page faults", "", "Minor and major, in all quiet windows together.", most=0.0),
        Figure("gc_runs", "Runs of the garbage collector", "", "The same.", most=0.0),
        Figure("allocated_blocks_growth", "Memory blocks that stay", "",
               "Blocks that the interpreter holds: least of the second half of the windows less least of the first.",
               most=0.0),
        Figure("resident_growth_kb", "Growth of the resident memory", "kB", "From the first to the last reading.",
               most=0.0),
        Figure("syscalls_per_tick", "System calls per tick", "",
               "Counted by strace for a few seconds after the measurement.", most=60.0),
        Figure("voluntary_switches_per_tick", "Times a tick that it waits", "",
               "Context switches that the process asked for: one for SYNC, one for the tick.", most=2.05),
        Figure("involuntary_switches_per_tick", "Times a tick that it is pushed off the processor", "",
               "By a process of higher priority or by the kernel."),
    ),
    (("stages.png", "Where the time of a tick goes: median, p99 and longest of every stage (log scale)."),),
)  # fmt: skip
PUNCTUAL: Final = Section(
    "Beside cyclictest",
    "Lateness of a wake-up is the host's more than ours. So cyclictest (rt-tests, in C, nothing to do) wakes at "
    "our priority on our core in the same seconds, 0.8 of a period after our tick, and a plain `time.sleep` loop of "
    "normal priority beside it. Only windows in which cyclictest says that the host was quiet are compared: its "
    "longest lateness within a fifth of the period, its p99 within a twentieth, steal within 0.5 %. A host with fewer "
    "than half its windows quiet cannot tell, and the verdict is *inconclusive*, whatever the numbers are.",
    (
        Figure("host_verdict", "Host quiet enough to tell (1 yes, 0 no)", "", "The rule above."),
        Figure("quiet_windows", "Quiet windows", "", "By the rule above."),
        Figure("windows", "of", "", "Windows in all."),
        Figure("wakeup_p50_us", "Our lateness, median", "us", "From the deadline to the first reading of the clock."),
        Figure("cyclictest_p50_us", "cyclictest's", "us", "Its own histogram."),
        Figure("wakeup_p50_ratio", "Ratio of the medians", "x",
               "Interpolated inside the bins of 1 us; interval by bootstrap over the windows.", most=1.5),
        Figure("wakeup_p99_us", "Our lateness, p99", "us", "As above."),
        Figure("cyclictest_p99_us", "cyclictest's", "us", "As above."),
        Figure("wakeup_p99_ratio", "Ratio of the p99", "x", "As above.", most=2.0),
        Figure("wakeup_p999_us", "Our lateness, p99.9", "us", "As above."),
        Figure("cyclictest_p999_us", "cyclictest's", "us", "As above."),
        Figure("wakeup_max_us", "Our longest lateness", "us", "As above."),
        Figure("cyclictest_max_us", "cyclictest's", "us", "As above."),
        Figure("plain_p50_us", "The plain loop's lateness, median", "us", "As above."),
        Figure("plain_p99_us", "The plain loop's, p99", "us", "As above."),
        Figure("judged_cycles", "Cycles judged", "", "Our ticks in the windows that are compared."),
        Figure("missed", "Deadlines missed in them", "",
               "Whole periods skipped; zero is asked for in 100,000 cycles.", most=0.0),
        Figure("steal_ms", "Time the hypervisor took", "ms", "/proc/stat, all processors, all windows."),
        Figure("pressure", "Share of time somebody waited for a processor", "%", "/proc/pressure/cpu.", scale=100.0),
    ),
    (("wakeups.png", "Lateness of wake-ups, quiet and with both cores loaded; the limit of a period is dashed."),),
)  # fmt: skip
LOADED: Final = Section(
    "With every core loaded",
    "stress-ng keeps every core and the memory busy. The plain loop runs in the same seconds on the same core and in "
    "the same session, as a script does that is started from the terminal of the load.",
    (
        Figure("wakeup_loaded_p50_us", "Our lateness, median", "us", "200 Hz."),
        Figure("wakeup_loaded_p99_us", "Our lateness, p99", "us", "200 Hz."),
        Figure("cyclictest_loaded_p99_us", "cyclictest's, p99", "us", "200 Hz."),
        Figure("plain_loaded_p99_us", "The plain loop's, p99", "us", "200 Hz."),
        Figure("missed_loaded", "Deadlines that we missed", "", "200 Hz."),
        Figure("missed_loaded_cyclictest", "that cyclictest missed", "", "Periods that its wake-ups were late by."),
        Figure("missed_loaded_plain", "that the plain loop missed", "", "Periods skipped."),
        Figure("missed_loaded_share", "Ours as a share of the plain loop's", "%", "200 Hz.", most=SHARE_OF_PLAIN,
               scale=100.0),
        Figure("wakeup1k_p99_us", "At 1 kHz, quiet: our lateness, p99", "us", "Fixed crane."),
        Figure("cyclictest1k_p99_us", "cyclictest's, p99", "us", "Fixed crane."),
        Figure("missed_1k", "Deadlines that we missed", "", "Fixed crane."),
        Figure("missed_loaded_1k", "At 1 kHz, loaded: deadlines that we missed", "", "Fixed crane."),
        Figure("missed_loaded_cyclictest_1k", "that cyclictest missed", "", "Fixed crane."),
        Figure("missed_loaded_plain_1k", "that the plain loop missed", "", "Fixed crane."),
        Figure("stops", "Stops of the machine in the whole measurement", "",
               "The controller's own supervisor may stop a machine whose loop is late."),
    ),
)  # fmt: skip
FRAMES: Final = Section(
    "From sample to command",
    "The encoders sample on SYNC; the tick that uses the samples sends the valve command. The wire gives every frame "
    "its time on the bus.",
    (
        Figure("sample_to_command_p50_us", "From the encoders' sample to the valve command, median", "us",
               "From the stamp of SYNC on the wire to the command handed to the bus, 200 Hz, quiet windows."),
        Figure("sample_to_command_p99_us", "The same, p99", "us", "One period is the limit.", most=5000.0,
               clocked=True),
        Figure("rx_decode_us", "Receive and decode one frame, raw path", "us", "On this host, per frame.", most=5.0,
               clocked=True),
        Figure("rx_decode_pythoncan_us", "The same through python-can", "us", "The same frames."),
    ),
    (
        ("sample-to-command.png", "From the encoders' sample to the valve command."),
        ("ages.png", "Age of every input when a tick used it: newest and longest."),
    ),
)  # fmt: skip
SECTIONS: Final = (OURS, PUNCTUAL, LOADED, FRAMES)
FIGURES: Final = tuple(f for section in SECTIONS for f in section.figures)
