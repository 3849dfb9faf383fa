"""The real-time report: verdicts from figures, the text without private words, and one real measurement."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from experiments.timing.fitness import (
    REMOVED,
    Figures,
    Measured,
    Verdict,
    data_of,
    judge,
    overall,
    private_words,
    read_data,
    text_of,
    without_private,
)
from host.doctor import facts
from host.doctor.facts import interrupt_counts
from timberhand.cli import app

GOOD = Figures(
    seconds=60.0,
    period_us=5000.0,
    ticks=12_000,
    missed=0,
    late_p50_us=8.0,
    late_p99_us=20.0,
    late_max_us=90.0,
    reference="cyclictest",
    reference_p99_us=12.0,
    reference_max_us=60.0,
    tick_p50_us=120.0,
    tick_p99_us=250.0,
    frames_lost=0,
    page_faults=0,
    gc_runs=0,
    stops=0,
    fifo=True,
    locked_kb=50_000,
    refused=(),
    steal_ms=0.0,
    load_before=0.05,
    emulated=False,
)


def verdict(topic: str, **changed: object) -> Verdict:
    return {j.topic: j.verdict for j in judge(replace(GOOD, **changed))}[topic]  # type: ignore[arg-type]


def test_a_quiet_computer_that_grants_everything_is_good() -> None:
    judged = judge(GOOD)
    assert overall(judged) is Verdict.GOOD
    assert not any(j.advice for j in judged)


@pytest.mark.parametrize(
    ("topic", "changed", "expected"),
    [
        ("rights", {"fifo": False, "refused": ("SCHED_FIFO 80: Operation not permitted",)}, Verdict.UNFIT),
        ("rights", {"locked_kb": 0}, Verdict.UNFIT),
        ("wake-ups", {"late_max_us": 501.0}, Verdict.MARGINAL),
        ("wake-ups", {"late_max_us": 2501.0}, Verdict.UNFIT),
        ("wake-ups", {"missed": 1}, Verdict.UNFIT),
        ("wake-ups", {"missed": 1, "steal_ms": 301.0}, Verdict.INCONCLUSIVE),
        ("wake-ups", {"missed": 1, "load_before": 0.6}, Verdict.INCONCLUSIVE),
        ("wake-ups", {"steal_ms": 301.0}, Verdict.GOOD),
        ("wake-ups", {"ticks": 4999}, Verdict.INCONCLUSIVE),
        ("wake-ups", {"late_max_us": float("nan")}, Verdict.INCONCLUSIVE),
        ("tick", {"tick_p99_us": 501.0}, Verdict.MARGINAL),
        ("tick", {"tick_p99_us": 1501.0}, Verdict.UNFIT),
        ("tick", {"tick_p99_us": 1501.0, "load_before": 0.6}, Verdict.INCONCLUSIVE),
        ("frames", {"frames_lost": 1}, Verdict.UNFIT),
        ("frames", {"frames_lost": 1, "emulated": True}, Verdict.INCONCLUSIVE),
        ("memory", {"page_faults": 1}, Verdict.MARGINAL),
        ("stops", {"stops": 1}, Verdict.UNFIT),
    ],
)
def test_each_limit_decides_its_own_verdict(topic: str, changed: dict[str, object], expected: Verdict) -> None:
    assert verdict(topic, **changed) is expected
    found = next(j for j in judge(replace(GOOD, **changed)) if j.topic == topic)  # type: ignore[arg-type]
    assert bool(found.advice) is (expected is not Verdict.GOOD)


def test_the_advice_names_the_computer_when_the_reference_loop_was_late_too_and_us_when_it_was_not() -> None:
    theirs = {j.topic: j for j in judge(replace(GOOD, missed=3, late_max_us=9000.0, reference_max_us=8000.0))}
    ours = {j.topic: j for j in judge(replace(GOOD, missed=3, late_max_us=9000.0))}
    assert theirs["wake-ups"].advice and ours["wake-ups"].advice
    assert theirs["wake-ups"].advice != ours["wake-ups"].advice


def test_names_and_private_paths_leave_every_text() -> None:
    words = private_words("alices-box", "alice", "root")
    text = "alices-box: alice cannot read /home/alice/.venv/lib or '/opt/x/y'; root may write /etc/default/grub, 3 1/s"
    found = without_private({"a": [text]}, words)["a"][0]
    assert found == (
        f"{REMOVED}: {REMOVED} cannot read {REMOVED} or '{REMOVED}'; root may write /etc/default/grub, 3 1/s"
    )


def test_the_report_holds_its_data_and_the_failure_of_a_measurement() -> None:
    found, machine = facts.read(Path("/")), facts.read_computer(Path("/"), "#1 SMP", 0)
    measured = Measured(GOOD, "wire", "aoro_fc8", 0, "interpreter", (), {"LOC": 7})
    data = data_of(found, machine, (), measured, private_words())
    assert read_data(text_of(data)) == data
    assert data["verdict"] == "good" and data["measured"]["figures"]["ticks"] == 12_000
    failed = data_of(found, machine, (), "/home/bob/run/guard.err says bob", private_words("bob"))
    assert failed["verdict"] == "unfit" and "bob" not in text_of(failed)
    with pytest.raises(ValueError):
        read_data("# Something else\n")


def test_facts_of_the_computer_from_a_test_tree(tmp_path: Path) -> None:
    for place, text in {
        "proc/cpuinfo": "processor : 0\nmodel name : Atom\nprocessor : 1\n",
        "proc/meminfo": "MemTotal: 2048 kB\n",
        "proc/cmdline": "root=UUID=1234 isolcpus=1 quiet nohz_full=1",
        "proc/irq/4/smp_affinity_list": "0-1",
        "proc/irq/5/smp_affinity_list": "0",
        "proc/irq/default_smp_affinity": "3\n",
    }.items():
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).write_text(text)
    found = facts.read_computer(tmp_path, "#1 SMP PREEMPT_RT", 1)
    assert found == facts.Computer("Atom", 2, 2, "#1 SMP PREEMPT_RT", ("isolcpus=1", "nohz_full=1"), (4,), 2, "3")
    counts = (
        "           CPU0       CPU1\n  4:  1  20  IO-APIC 4-edge  can0\nLOC:  5  6  Local timer interrupts\nERR: 0\n"
    )
    assert interrupt_counts(counts, 1) == {"can0": 20, "LOC": 6}
    assert interrupt_counts(counts, 2) == {}


def test_a_report_that_cannot_be_written_is_refused_before_the_measurement(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["doctor", "--rt", "--report", "--out", str(tmp_path / "none" / "report.md")])
    assert getattr(done.exception, "code", "") == "doctor.no-report"
