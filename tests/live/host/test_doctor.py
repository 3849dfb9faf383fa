"""The doctor: facts from test trees of /proc and /sys, their evaluation, the output, and the tuning script."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from host.doctor import installation
from host.doctor.finding import Severity

ROOT = Path(__file__).parents[3]
TUNE = ROOT / "deploy/tune.sh"


# ------------------------------------------------------------------------------- installation
def test_this_installation_has_no_fault() -> None:
    assert [f for f in installation.examine() if f.severity is Severity.FAULT] == []


def test_the_command_answers_in_json() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "timberhand", "doctor", "--rt", "--json"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert set(told) == {"installation", "timing"}
    assert {f["severity"] for group in told.values() for f in group} <= {"fine", "advice", "change"}
    assert set(told["timing"][0]) == {"what", "severity", "sentence", "gain", "commands"}


# ------------------------------------------------------------------------------- tune.sh
@pytest.fixture
def computer(tmp_path: Path) -> Path:
    """A made-up tree that can be tuned."""
    files = {
        **{f"sys/devices/system/cpu/cpu{n}/cpufreq/scaling_governor": "powersave" for n in range(4)},
        "sys/devices/system/cpu/online": "0-3",
        "sys/devices/system/cpu/isolated": "",
        "sys/devices/system/cpu/cpu3/cpuidle/state0/latency": "2",
        "sys/devices/system/cpu/cpu3/cpuidle/state0/disable": "0",
        "sys/devices/system/cpu/cpu3/cpuidle/state1/latency": "890",
        "sys/devices/system/cpu/cpu3/cpuidle/state1/disable": "0",
        "sys/kernel/mm/transparent_hugepage/enabled": "[always] madvise never",
        "sys/devices/virtual/workqueue/cpumask": "0f",
        "proc/sys/kernel/sched_rt_runtime_us": "500000",
        "proc/irq/130/smp_affinity_list": "0-3",
        "proc/irq/131/smp_affinity_list": "1",
        "run/.keep": "",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text + "\n")
    return tmp_path


def tune(root: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["sh", str(TUNE), "--root", str(root), *words], capture_output=True, text=True)


def contents(root: Path) -> dict[str, str]:
    return {str(p.relative_to(root)): p.read_text() for p in root.rglob("*") if p.is_file()}


def test_tuning_is_shown_applied_once_and_undone(computer: Path) -> None:
    before = contents(computer)
    shown = tune(computer, "--cpu", "3")
    assert shown.returncode == 0, shown.stderr
    assert contents(computer) == before
    assert "cpu3/cpufreq/scaling_governor: powersave -> performance" in shown.stdout
    assert "isolcpus=managed_irq,domain,3 nohz_full=3 rcu_nocbs=3 irqaffinity=0-2" in shown.stdout
    assert "PREEMPT_RT" in shown.stderr

    assert tune(computer, "--cpu", "3", "--apply").returncode == 0
    after = contents(computer)
    changed = {name: text.strip() for name, text in after.items() if before.get(name) != text}
    del changed["run/timberhand-tune"]
    assert changed == {
        "sys/devices/system/cpu/cpu3/cpufreq/scaling_governor": "performance",
        "sys/devices/system/cpu/cpu3/cpuidle/state1/disable": "1",
        "sys/kernel/mm/transparent_hugepage/enabled": "madvise",
        "sys/devices/virtual/workqueue/cpumask": "07",
        "proc/sys/kernel/sched_rt_runtime_us": "950000",
        "proc/irq/130/smp_affinity_list": "0-2",
        "proc/irq/131/smp_affinity_list": "0-2",
    }
    assert tune(computer, "--cpu", "3", "--apply").returncode == 0
    assert contents(computer) == after

    (computer / "proc/irq/130/smp_affinity_list").write_text("1\n")  # somebody moves it: what was first is kept
    assert tune(computer, "--cpu", "3", "--apply").returncode == 0
    assert tune(computer, "--undo").returncode == 0
    undone = contents(computer)
    name = "sys/kernel/mm/transparent_hugepage/enabled"  # the kernel takes the word alone and shows it in brackets
    assert (undone.pop(name), before.pop(name)) == ("always\n", "[always] madvise never\n")
    assert undone == before
    now = contents(computer)
    tune(computer, "--undo")
    assert contents(computer) == now


def test_without_a_processor_only_global_settings_change(computer: Path) -> None:
    assert tune(computer, "--apply").returncode == 0
    governors = [p.read_text() for p in sorted(computer.glob("sys/devices/system/cpu/cpu*/cpufreq/scaling_governor"))]
    assert governors == ["performance\n"] * 4
    assert (computer / "proc/irq/130/smp_affinity_list").read_text() == "0-3\n"


@pytest.mark.parametrize(
    ("words", "named"),
    [(["--cpu", "9"], "9"), (["--cpu", "x"], "x"), (["--fast"], "--fast")],
)
def test_what_cannot_be_tuned_is_refused(computer: Path, words: list[str], named: str) -> None:
    done = tune(computer, *words)
    assert (done.returncode, named in done.stderr) == (2, True)


def test_the_scripts_are_clean() -> None:
    if not any(Path(folder, "shellcheck").exists() for folder in os.get_exec_path()):
        pytest.skip("shellcheck is missing (apt-get install shellcheck)")
    scripts = [TUNE, ROOT / "deploy/lab_kernel/build.sh"]
    done = subprocess.run(["shellcheck", *scripts], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
