"""The update's decisions: who is refused, what comes back by itself, and what the gate wants to see."""

from __future__ import annotations

import errno
import os
import signal
from contextlib import nullcontext
from pathlib import Path

import pytest

from host.exit_codes import CommandFailed, ExitCode
from host.release.gate import HOLD_NS, LIMIT_NS, Gate, Passage, ServiceReading, lacking
from host.release.trees import State, Trees
from host.release.updater import ROLLBACK, UPDATE, Step, after_interruption
from tests.codes import coded
from tests.host.small_releases import DEAD, GOOD, NotedProgram, NotedServices, install, keys, small_bundle, updater
from timberhand.commands import service

S_NS = 1_000_000_000


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], Path]:
    folder = tmp_path_factory.mktemp("bundles")
    private, public = keys(folder)
    return [small_bundle(folder / version, version, private) for version in ("1.0", "2.0")], public


@pytest.fixture
def installed(made: tuple[list[Path], Path], tmp_path: Path) -> Trees:
    trees = Trees(tmp_path)
    install(trees, made[0][0], made[1])
    return trees


def in_use(trees: Trees) -> str:
    return (trees.state().current or "none").partition("-")[0]


def test_the_release_changes_while_the_services_are_stopped(made: tuple[list[Path], Path], installed: Trees) -> None:
    services, program, told = NotedServices(installed), NotedProgram(), []
    updater(installed, made[1], services, program, told.append).update(made[0][1])
    assert in_use(installed) == "2.0" and services.told == ["stop", "reload", "start", "judged", "start others"]
    assert program.told == ["check", "links"]
    assert told == [step.value for step in UPDATE]
    updater(installed, made[1], services).rollback()
    assert in_use(installed) == "1.0"
    updater(installed, made[1], services).rollback()
    assert in_use(installed) == "2.0", "back and forth"


def test_the_same_bundle_again_changes_nothing(made: tuple[list[Path], Path], installed: Trees) -> None:
    services = NotedServices(installed)
    updater(installed, made[1], services).update(made[0][0])
    assert services.told == [] and installed.state().previous is None and not installed.incoming.exists()


def test_a_release_that_does_not_come_up_is_changed_back(made: tuple[list[Path], Path], installed: Trees) -> None:
    services = NotedServices(installed, "2.0")
    with pytest.raises(CommandFailed, match=r"1\.0", check=coded("update.gate")) as refused:
        updater(installed, made[1], services).update(made[0][1])
    assert refused.value.exit_code == ExitCode.FIGURE_MISSED
    assert in_use(installed) == "1.0" and installed.state().trial is None
    assert services.told == ["stop", "reload", "start", "judged", "stop", "reload", "start", "start others"]
    assert (services.running or "").startswith("1.0")


@pytest.mark.parametrize("broken", ["2.0", "no release"])
def test_a_terminal_that_is_gone_keeps_no_update_from_its_end(
    made: tuple[list[Path], Path], installed: Trees, broken: str
) -> None:
    services = NotedServices(installed, broken)

    def gone(line: str) -> None:
        if "stop" in services.told:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    with pytest.raises(CommandFailed, check=coded("update.gate")) if broken == "2.0" else nullcontext():
        updater(installed, made[1], services, report=gone).update(made[0][1])
    assert in_use(installed) == ("1.0" if broken == "2.0" else "2.0") and installed.state().trial is None
    assert services.told[-1] == "start others"


def test_a_lost_terminal_ends_no_update(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """ssh without a network sends SIGHUP, `| tee` that Ctrl-C ends SIGPIPE: the services would stay stopped."""
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr("timberhand.service_status.SYSTEMD", tmp_path)
    before = {number: signal.getsignal(number) for number in (signal.SIGHUP, signal.SIGPIPE)}
    try:
        service._updater()
        assert {signal.getsignal(number) for number in before} == {signal.SIG_IGN}
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.parametrize("mode", ["ARMED", "ACTIVE"])
def test_an_armed_machine_is_not_updated(made: tuple[list[Path], Path], installed: Trees, mode: str) -> None:
    services = NotedServices(installed)
    services.armed = mode
    with pytest.raises(CommandFailed, check=coded("update.armed")) as refused:
        updater(installed, made[1], services).update(made[0][1])
    assert refused.value.exit_code == ExitCode.SAFETY_STOP
    assert in_use(installed) == "1.0" and services.told == [] and not installed.incoming.exists()


def test_a_machine_that_is_armed_meanwhile_is_not_updated(made: tuple[list[Path], Path], installed: Trees) -> None:
    services = NotedServices(installed)

    class Slow(NotedProgram):
        def build(self, incoming: Path, tree: Path) -> None:
            super().build(incoming, tree)
            services.armed = "ACTIVE"

    with pytest.raises(CommandFailed, check=coded("update.armed")):
        updater(installed, made[1], services, Slow()).update(made[0][1])
    assert in_use(installed) == "1.0" and services.told == []


def test_settings_that_the_new_release_refuses_stop_the_update(made: tuple[list[Path], Path], installed: Trees) -> None:
    class Refusing(NotedProgram):
        def check(self, tree: Path) -> None:
            raise CommandFailed("update.refused", "no", ExitCode.CONFIGURATION)

    services = NotedServices(installed)
    with pytest.raises(CommandFailed, check=coded("update.refused")):
        updater(installed, made[1], services, Refusing()).update(made[0][1])
    assert in_use(installed) == "1.0" and services.told == []


def test_ctrl_c_at_the_gate_leaves_the_former_release(made: tuple[list[Path], Path], installed: Trees) -> None:
    class Impatient(NotedServices):
        def readings(self) -> tuple[ServiceReading, ServiceReading]:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        updater(installed, made[1], Impatient(installed)).update(made[0][1])
    assert in_use(installed) == "1.0" and installed.state().trial is None


def test_a_full_disk_is_one_sentence_and_changes_nothing(made: tuple[list[Path], Path], installed: Trees) -> None:
    class Full(NotedProgram):
        def build(self, incoming: Path, tree: Path) -> None:
            tree.mkdir()
            raise OSError(28, "No space left on device", str(tree))

    with pytest.raises(CommandFailed, check=coded("update.disk")):
        updater(installed, made[1], NotedServices(installed), Full()).update(made[0][1])
    assert [name.partition("-")[0] for name in installed.whole()] == ["1.0"]
    assert len(list(installed.releases.iterdir())) == 1, "nothing of it stays"


def test_two_updates_at_a_time_are_refused(made: tuple[list[Path], Path], installed: Trees) -> None:
    class Second(NotedProgram):
        def links(self, tree: Path) -> None:
            with pytest.raises(CommandFailed, check=coded("update.running")):
                updater(installed, made[1], NotedServices(installed)).update(made[0][1])
            super().links(tree)

    program = Second()
    updater(installed, made[1], NotedServices(installed), program).update(made[0][1])
    assert in_use(installed) == "2.0" and program.told == ["check", "links"]


def test_without_an_installation_or_a_former_release_there_is_a_sentence(
    made: tuple[list[Path], Path], installed: Trees, tmp_path: Path
) -> None:
    with pytest.raises(CommandFailed, check=coded("update.no-previous")):
        updater(installed, made[1], NotedServices(installed)).rollback()
    nothing = Trees(tmp_path / "nothing")
    with pytest.raises(CommandFailed, check=coded("update.not-installed")):
        updater(nothing, made[1], NotedServices(nothing)).update(made[0][1])


def test_the_release_is_on_the_disk_before_it_is_whole_and_before_it_is_used(
    made: tuple[list[Path], Path], installed: Trees, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a kill cannot show: in which order data reaches the disk."""
    told: list[str] = []
    replace, fsync = os.replace, os.fsync
    monkeypatch.setattr(os, "sync", lambda: told.append("sync"))

    def replaced(source: Path, target: Path) -> None:
        told.append(Path(target).name)
        replace(source, target)

    def flushed(descriptor: int) -> None:
        told.append(f"flush {Path(os.readlink(f'/proc/self/fd/{descriptor}')).name}")
        fsync(descriptor)

    monkeypatch.setattr(os, "replace", replaced)
    monkeypatch.setattr(os, "fsync", flushed)
    updater(installed, made[1], NotedServices(installed)).update(made[0][1])
    name = installed.state().current
    opt = installed.place.name
    assert told == [
        "sync",
        "flush release.json.new",
        "release.json",
        f"flush {name}",
        "flush releases",
        "trial",
        f"flush {opt}",
        "current",
        f"flush {opt}",
        "previous",
        f"flush {opt}",
    ]


def test_after_a_power_cut_the_links_say_what_is_left() -> None:
    assert after_interruption(State("a", None, None)) == (Step.CLEAR,)
    assert after_interruption(State("a", None, "a")) == (Step.END_TRIAL, Step.CLEAR), "it was never changed"
    assert after_interruption(State("b", "z", "a")) == (Step.GATE, Step.START_OTHERS, Step.ACCEPT, Step.PRUNE)


def test_the_machine_is_disarmed_when_the_services_stop_and_there_is_a_way_back_when_the_release_changes() -> None:
    for steps in (UPDATE, ROLLBACK):
        at = steps.index(Step.STOP)
        assert steps[at - 2 : at] == (Step.DISARMED, Step.TRY)
        assert steps.index(Step.TRY) < steps.index(Step.SWITCH) < steps.index(Step.GATE) < steps.index(Step.ACCEPT)
        assert steps.index(Step.GATE) < steps.index(Step.START_OTHERS) < steps.index(Step.ACCEPT)
        assert steps.index(Step.CHECK) < steps.index(Step.TRY)
    assert UPDATE.index(Step.VERIFY) < UPDATE.index(Step.BUILD)


def test_the_gate_opens_after_a_while_of_ready_standby_and_good() -> None:
    gate = Gate(0)
    assert gate.step(*GOOD, S_NS) is Passage.WAITING
    assert gate.step(*GOOD, S_NS + HOLD_NS - 1) is Passage.WAITING
    assert gate.step(*GOOD, S_NS + HOLD_NS) is Passage.PASSED


def test_a_service_that_restarts_begins_its_time_again() -> None:
    gate, again = Gate(0), (ServiceReading(True, GOOD[0].words, 99), GOOD[1])
    gate.step(*GOOD, 0)
    assert gate.step(*again, HOLD_NS) is Passage.WAITING
    assert gate.step(*again, 2 * HOLD_NS) is Passage.PASSED
    assert gate.step(*GOOD, LIMIT_NS) is Passage.REFUSED and gate.lacking


def test_a_verdict_that_comes_and_goes_is_said_and_is_no_restart() -> None:
    stale = ServiceReading(True, "Valves not enabled: STALE. The bus is ACTIVE.", GOOD[1].pid)
    gate = Gate(0)
    gate.step(GOOD[0], stale, LIMIT_NS - S_NS)
    assert gate.step(*GOOD, LIMIT_NS) is Passage.REFUSED
    assert "STALE" in gate.lacking


def test_a_release_that_comes_up_too_late_is_said_so() -> None:
    gate = Gate(0)
    assert gate.step(*GOOD, LIMIT_NS) is Passage.REFUSED and gate.lacking


@pytest.mark.parametrize(
    ("controller", "guard", "names"),
    [
        (DEAD, GOOD[1], ("controller", "READY")),
        (ServiceReading(True, "BOOT. Encoders.", 1), GOOD[1], ("controller", "STANDBY", "BOOT. Encoders.")),
        (ServiceReading(True, "FAULT. x", 1), GOOD[1], ("controller", "STANDBY", "FAULT. x")),
        (GOOD[0], DEAD, ("guard", "READY")),
        (GOOD[0], ServiceReading(True, "Valves not enabled: ESTOP. x", 1), ("guard", "GOOD", "ESTOP. x")),
    ],
)
def test_what_the_gate_lacks_is_said(controller: ServiceReading, guard: ServiceReading, names: tuple[str, ...]) -> None:
    said = lacking(controller, guard)
    assert all(name in said for name in names)
    gate = Gate(0)
    assert gate.step(controller, guard, LIMIT_NS - 1) is Passage.WAITING
    assert gate.step(controller, guard, LIMIT_NS) is Passage.REFUSED and gate.lacking.startswith(said)


def test_the_gate_reads_the_words_that_controller_and_guard_really_say() -> None:
    import controller.guard.__main__ as guard_process
    from controller.guard.guard import Guard

    guard = guard_process.build(guard_process.profile_path("palms_471"))
    assert isinstance(guard, Guard)
    text = guard_process._status_text(guard, [])
    assert text.startswith(f"Valves not enabled: {guard.verdict.name}. ")
