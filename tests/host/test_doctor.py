"""The doctor: facts from test trees of /proc and /sys, their evaluation, the output, and the tuning script."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from host.doctor import installation
from host.doctor.facts import UNLIMITED, CanLink, Facts, cpu_set, read
from host.doctor.finding import Finding, Severity, conclusion, fine, show
from host.doctor.timing import evaluate
from machine.loading.profile_file import ProfileError

GOOD = {
    "proc/version": "Linux version 6.1.0-rt7 (gcc) #1 SMP PREEMPT_RT Debian",
    "proc/sys/kernel/osrelease": "6.1.0-rt7",
    "sys/kernel/realtime": "1",
    "proc/cmdline": "isolcpus=managed_irq,domain,3 nohz_full=3 rcu_nocbs=3 quiet",
    "proc/cpuinfo": "processor : 0\nflags\t\t: fpu tsc\n",
    "proc/self/limits": "Max locked memory         8388608              unlimited            bytes\n"
    "Max realtime priority     0                    95\n",
    "proc/self/status": "Name:\tpython\nCapEff:\t0000000000000000\n",
    "proc/self/timerslack_ns": "50000",
    "proc/swaps": "Filename Type Size Used Priority\n",
    "proc/sys/kernel/sched_rt_runtime_us": "950000",
    "proc/sys/kernel/sched_rt_period_us": "1000000",
    "proc/15/stat": f"15 (ksoftirqd/0) S 2 0 0 0 -1 {'0 ' * 9}-61 0 1 {'0 ' * 16}17 0 0 60 1 0 0",
    "proc/901/stat": "901 (a (b) c) S 1 0",
    "proc/irq/130/smp_affinity_list": "0-2",
    "sys/devices/system/cpu/online": "0-3",
    "sys/devices/system/cpu/isolated": "3",
    "sys/devices/system/cpu/nohz_full": "3",
    **{f"sys/devices/system/cpu/cpu{n}/cpufreq/scaling_governor": "performance" for n in range(4)},
    "sys/devices/system/cpu/cpu3/topology/thread_siblings_list": "3",
    "sys/devices/system/cpu/cpu3/cpuidle/state0/name": "POLL",
    "sys/devices/system/cpu/cpu3/cpuidle/state0/latency": "0",
    "sys/devices/system/cpu/cpu3/cpuidle/state1/name": "C10",
    "sys/devices/system/cpu/cpu3/cpuidle/state1/latency": "890",
    "sys/devices/system/cpu/cpu3/cpuidle/state1/disable": "1",
    "sys/devices/system/clocksource/clocksource0/current_clocksource": "tsc",
    "sys/kernel/mm/transparent_hugepage/enabled": "always [madvise] never",
    "sys/devices/pci0/can0-device/msi_irqs/130": "",
    "dev/cpu_dma_latency": "",
    "etc/timberhand/timberhand.conf": "# as in CONTROLLER_OPTIONS=--cpu 7\nCONTROLLER_OPTIONS=--spin-us 120 --cpu 3\n",
}
LINKS: list[dict[str, Any]] = [
    {"ifname": "lo", "link_type": "loopback"},
    {
        "ifname": "crane0",
        "flags": ["NOARP", "UP"],
        "link_type": "can",
        "txqlen": 32,
        "linkinfo": {
            "info_kind": "can",
            "info_data": {
                "state": "ERROR-ACTIVE",
                "berr_counter": {"tx": 0, "rx": 0},
                "restart_ms": 100,
                "bittiming": {"bitrate": 1000000},
            },
            "info_xstats": {"restarts": 0, "bus_error": 0, "error_passive": 0, "bus_off": 0},
        },
    },
]
Tree = Callable[..., Facts]
Changes = dict[str, str | None]


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    """Facts of a good computer with some files changed (None: absent)."""

    def make(links: list[dict[str, Any]] = LINKS, cpu: int | None = None, **changed: str | None) -> Facts:
        files = {**GOOD, **{name.replace("__", "/"): text for name, text in changed.items()}}
        for name, text in files.items():
            path = tmp_path / name
            path.unlink(missing_ok=True)
            if text is not None:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text + "\n")
        device = tmp_path / "sys/class/net/crane0/device"
        if not device.is_symlink():
            device.parent.mkdir(parents=True)
            device.symlink_to("../../../devices/pci0/can0-device")
        return read(tmp_path, json.dumps(links), cpu)

    return make


def of(facts: Facts, what: str) -> Finding:
    return next(finding for finding in evaluate(facts) if finding.what == what)


# ------------------------------------------------------------------------------- facts
def test_a_well_tuned_computer_needs_no_change(tree: Tree) -> None:
    facts = tree()
    assert (facts.preemption, facts.machine, facts.control_cpu) == ("rt", "", 3)
    assert (facts.isolated, facts.tickless, facts.rcu_offloaded) == ({3}, {3}, {3})
    assert (facts.rtprio_limit, facts.memlock_limit) == (95, UNLIMITED)
    assert facts.softirq_threads == {0: "FIFO 60"}
    assert facts.links[0].interrupts == (130,)
    assert facts.links[0].interrupt_cpus == {0, 1, 2}
    assert [f for f in evaluate(facts) if f.severity is not Severity.FINE] == []


def test_an_empty_tree_gives_unknown_facts_and_no_error(tmp_path: Path) -> None:
    facts = read(tmp_path)
    assert (facts.preemption, facts.rt_runtime_us, facts.links) == ("", None, ())
    assert all(finding.sentence for finding in evaluate(facts))


@pytest.mark.parametrize(
    ("text", "numbers"), [("0-2,5", {0, 1, 2, 5}), ("managed_irq,domain,3", {3}), ("", set()), ("7\n", {7})]
)
def test_a_list_of_processors(text: str, numbers: set[int]) -> None:
    assert cpu_set(text) == numbers


@pytest.mark.parametrize(
    ("version", "chosen", "expected"),
    [
        ("#1 SMP PREEMPT_DYNAMIC Debian", "none voluntary (full) lazy", "full"),
        ("#1 SMP PREEMPT_DYNAMIC Debian", None, "dynamic"),
        ("#1 SMP PREEMPT Debian", None, "full"),
        ("#1 SMP Debian", None, ""),
    ],
)
def test_the_preemption_model_is_read_from_the_kernel(
    tree: Tree, version: str, chosen: str | None, expected: str
) -> None:
    changes = {"proc__version": version, "sys__kernel__realtime": None, "sys__kernel__debug__sched__preempt": chosen}
    assert tree(**changes).preemption == expected


# ------------------------------------------------------------------------------- findings
CPUS, CPU3 = "sys__devices__system__cpu__", "sys__devices__system__cpu__cpu3__"
GOVERNOR, DEEP_SLEEP = CPU3 + "cpufreq__scaling_governor", CPU3 + "cpuidle__state1__disable"
CLOCK = "sys__devices__system__clocksource__clocksource0__current_clocksource"
HUGE_PAGES = "sys__kernel__mm__transparent_hugepage__enabled"
RT_RUNTIME = "proc__sys__kernel__sched_rt_runtime_us"
CONF = "etc__timberhand__timberhand.conf"
UNPINNED: Changes = {CONF: "CONTROLLER_OPTIONS=\n"}
BALANCED: Changes = {"proc__901__stat": "901 (irqbalance) S 1"}
NO_RT: Changes = {"proc__version": "#1 SMP PREEMPT Debian", "sys__kernel__realtime": "0"}
PINNED: Changes = {
    "etc__systemd__system__timberhand-controller.service.d__50-processor.conf": "[Service]\nCPUAffinity=2\n"
}
TICKING: Changes = {CPUS + "nohz_full": "", "proc__cmdline": "rcu_nocbs=3"}
UNIT = "usr__lib__systemd__system__timberhand-controller.service"
CASES: list[tuple[str, Changes, Severity, str, str]] = [
    ("priority", {"proc__self__limits": "Max realtime priority  0  0\n"}, Severity.CHANGE, "FIFO 0", "rtprio 90"),
    ("memory", {"proc__self__limits": "Max locked memory  65536  65536\n"}, Severity.CHANGE, "64 kB", "memlock"),
    ("kernel", NO_RT, Severity.CHANGE, "'full'", "linux-image-rt-amd64"),
    ("machine", {"proc__cpuinfo": "flags : fpu hypervisor"}, Severity.ADVICE, "", ""),
    ("clock rate", {GOVERNOR: "powersave"}, Severity.CHANGE, "powersave", "tune.sh --apply --cpu 3"),
    ("processor", {CPUS + "isolated": ""}, Severity.CHANGE, "3", "isolcpus=managed_irq,domain,3"),
    ("processor", TICKING, Severity.ADVICE, "nohz_full", "nohz_full=3"),
    ("processor", UNPINNED | {CPUS + "isolated": ""}, Severity.ADVICE, "", "service install --cpu 3"),
    ("processor", UNPINNED, Severity.CHANGE, "3", "service install --cpu 3"),
    ("processor", UNPINNED | PINNED, Severity.CHANGE, "2", "service install --cpu any"),
    ("processor", {CONF: "CONTROLLER_OPTIONS=--cpu 9\n"}, Severity.CHANGE, "9", "nano"),
    ("sibling", {CPU3 + "topology__thread_siblings_list": "1,3"}, Severity.ADVICE, "1", "cpu1/online"),
    ("interrupts", {"proc__irq__130__smp_affinity_list": "0-3"}, Severity.CHANGE, "130", "tune.sh"),
    ("irqbalance", BALANCED | {CPUS + "isolated": ""}, Severity.CHANGE, "3", "IRQBALANCE_BANNED_CPULIST=3"),
    ("sleep", {DEEP_SLEEP: "0"}, Severity.ADVICE, "890 us", "--dma-latency"),
    ("delivery", {"proc__15__stat": GOOD["proc/15/stat"].replace(" 60 1 ", " 0 0 ")}, Severity.ADVICE, "", "chrt"),
    ("task groups", {"proc__sys__kernel__sched_autogroup_enabled": "1"}, Severity.ADVICE, "session", "=0"),
    ("throttling", {RT_RUNTIME: "-1"}, Severity.ADVICE, "", "950000"),
    ("throttling", {RT_RUNTIME: "500000"}, Severity.CHANGE, "50%", "tune.sh"),
    ("clock", {CLOCK: "hpet"}, Severity.CHANGE, "hpet", "dmesg"),
    ("huge pages", {HUGE_PAGES: "[always] madvise never"}, Severity.ADVICE, "", "tune.sh"),
]


@pytest.mark.parametrize(("what", "changes", "severity", "sentence", "command"), CASES)
def test_a_suggested_change_names_its_values_and_its_command(
    tree: Tree, what: str, changes: Changes, severity: Severity, sentence: str, command: str
) -> None:
    found = of(tree(**changes), what)
    assert found.severity is severity
    assert sentence in found.sentence
    assert command in "\n".join(found.commands)
    assert found.gain


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"proc__self__status": "CapEff:\t000001ffffffffff", "proc__self__limits": ""}, "priority"),
        ({UNIT: "LimitRTPRIO=80\nLimitMEMLOCK=infinity\n", "proc__self__limits": ""}, "memory"),
        ({CONF: "CONTROLLER_OPTIONS=--dma-latency --cpu 3\n", DEEP_SLEEP: "0"}, "sleep"),
        (BALANCED | {"etc__default__irqbalance": "IRQBALANCE_BANNED_CPULIST=2-3"}, "irqbalance"),
    ],
)
def test_what_is_granted_by_other_means_is_fine(tree: Tree, changes: Changes, what: str) -> None:
    assert of(tree(**changes), what).severity is Severity.FINE


@pytest.mark.parametrize(
    ("change", "severity", "sentence"),
    [
        ({"up": False}, Severity.CHANGE, ""),
        ({"state": "ERROR-PASSIVE"}, Severity.CHANGE, "ERROR-PASSIVE"),
        ({"counters": {"bus_off": 2}}, Severity.CHANGE, "bus_off 2"),
        ({"restart_ms": 0}, Severity.ADVICE, ""),
        ({"sample_point": 0.6}, Severity.CHANGE, "60.0"),
        ({"sample_point": 0.875}, Severity.FINE, "87.5"),
        ({"sample_point": 0.0}, Severity.FINE, ""),
        ({"virtual": True}, Severity.FINE, ""),
    ],
)
def test_the_state_of_a_can_interface(tree: Tree, change: dict[str, Any], severity: Severity, sentence: str) -> None:
    facts = tree()
    link: CanLink = replace(facts.links[0], **change)
    found = of(replace(facts, links=(link,)), "CAN crane0")
    assert (found.severity, sentence in found.sentence) == (severity, True)


def test_an_interface_of_any_name_comes_up_by_the_services_of_the_buses(tree: Tree) -> None:
    """`deploy/system/can-up` knows the buses, and by the settings their interfaces."""
    facts = tree()
    for change in ({"up": False}, {"restart_ms": 0}):
        link = replace(facts.links[0], name="can0", **change)
        (command,) = of(replace(facts, links=(link,)), "CAN can0").commands
        assert set(re.findall(r"timberhand-can@(\w+)", command)) == {"crane0", "mach0"}


@pytest.mark.parametrize(
    ("address", "missing"),
    [
        ("socketcan:nowhere0", ["CRANE_BUS"]),
        ("python-can:socketcan:nowhere0", ["CRANE_BUS"]),
        ("socketcan:lo", []),
        ("kvaser:0", []),
        ("python-can:kvaser:0", []),
    ],
)
def test_only_interfaces_of_the_kernel_are_looked_for(
    address: str, missing: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(installation, "_settings", lambda: {"CRANE_BUS": address})
    assert [f.sentence.split("=")[0] for f in installation.buses() if f.severity is Severity.CHANGE] == missing


def test_the_greatest_gain_comes_first(tree: Tree) -> None:
    names = [finding.what for finding in evaluate(tree())]
    assert names[:3] == ["priority", "memory", "kernel"]
    assert names[-1] == "CAN crane0"


def test_a_profile_that_does_not_load_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(name: str) -> None:
        raise ProfileError("profile.wrong-structure", f"{name}: rate_hz: missing")

    monkeypatch.setattr(installation, "load_profile", broken)
    assert {f.severity for f in installation.profiles()} == {Severity.FAULT}


@pytest.mark.parametrize(
    ("mode", "secret", "severity", "sentence"),
    [
        (0o440, b"s" * 44, Severity.FINE, ""),
        (0o444, b"s" * 44, Severity.FAULT, ""),
        (0o460, b"s" * 44, Severity.FAULT, ""),
        (0o440, b"short", Severity.FAULT, "5"),
        (0o440, None, Severity.FAULT, ""),
    ],
)
def test_the_key_of_the_services_is_there_and_secret(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, mode: int, secret: bytes | None, severity: Severity, sentence: str
) -> None:
    monkeypatch.setattr(installation, "CONF", tmp_path / "timberhand.conf")
    monkeypatch.setattr(installation, "SERVICE_KEY", tmp_path / "key")
    monkeypatch.setattr(installation, "KEY_OWNER", tmp_path.stat().st_uid)
    assert list(installation.key()) == []
    (tmp_path / "timberhand.conf").touch()
    if secret is not None:
        (tmp_path / "key").write_bytes(secret)
        (tmp_path / "key").chmod(mode)
    (found,) = installation.key()
    assert (found.severity, sentence in found.sentence) == (severity, True)


@pytest.mark.parametrize(
    ("camera", "frames", "severity"),
    [
        ("stick", "", Severity.ADVICE),
        ("stick", "zed", Severity.CHANGE),
        ("stick", "/no/such/folder", Severity.CHANGE),
        ("stick", "127.0.0.1:24711", Severity.FINE),
    ],
)
def test_what_delivers_the_pictures_is_looked_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, camera: str, frames: str, severity: Severity
) -> None:
    monkeypatch.setattr(installation, "CONF", tmp_path / "timberhand.conf")
    assert list(installation.camera()) == []
    text = f"CAMERA={camera}\nCAMERA_FRAMES={frames}\nSCENE=127.0.0.1:24710\n"
    (tmp_path / "timberhand.conf").write_text(text)
    (found,) = installation.camera()
    assert found.severity is severity


@pytest.mark.parametrize("value", ["84710", "0", "²", "page", ""])
def test_a_setting_that_is_no_port_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, value: str) -> None:
    monkeypatch.setattr(installation, "CONF", tmp_path / "timberhand.conf")
    (tmp_path / "timberhand.conf").write_text(f"SETPOINT_PORT=24701 \nCONSOLE_PORT={value}\n")
    found = installation.ports()
    assert found.severity is Severity.CHANGE and f"CONSOLE_PORT={value} is no port" in found.sentence


def test_a_missing_package_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    needs = ["no-such-thing>=1", "typer>=999", "pybullet; extra == 'sim'", "nor-this-one; extra == 'sim'"]
    monkeypatch.setattr(installation.metadata, "requires", lambda _: needs)
    base, sim = installation.packages()
    assert (base.severity, sim.severity) == (Severity.FAULT, Severity.ADVICE)
    assert "no-such-thing" in base.sentence
    assert "typer >=999" in base.sentence
    assert "nor-this-one" in sim.sentence


# ------------------------------------------------------------------------------- output
def test_the_terminal_shows_what_to_change_before_what_is_fine(capsys: pytest.CaptureFixture[str]) -> None:
    bad = Finding("clock", Severity.CHANGE, "it is slow", "it is fast", ("sudo make it [fast]",))
    show(Console(width=60, highlight=False), "timing", [fine("kernel", "is there"), bad])
    said = capsys.readouterr().out
    assert said.index("it is slow") < said.index("it is fast") < said.index("$ sudo make it [fast]")
    assert said.index("$ sudo") < said.index("kernel")


@pytest.mark.parametrize(
    ("severities", "words"),
    [
        ([Severity.FINE], ""),
        ([Severity.FINE, Severity.ADVICE], "1 improvement"),
        ([Severity.CHANGE, Severity.CHANGE, Severity.ADVICE], "2 changes"),
        ([Severity.FAULT, Severity.CHANGE], "1 fault"),
    ],
)
def test_the_last_line_counts_the_findings_of_the_worst_severity(severities: list[Severity], words: str) -> None:
    assert words in conclusion([Finding("x", severity, "y") for severity in severities])
