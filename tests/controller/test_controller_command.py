"""The controller's command: start errors with their exit codes, addresses, and one run from start to signal."""

import pytest

from can_dbc.messages.envelope import write_key
from controller.process.command import main
from controller.process.setpoint_port import listen
from tests.codes import numbers_in


def test_start_errors_have_their_code_and_one_sentence(capsys, tmp_path):
    good = ["--setpoint-port", "0", "--key-file", str(write_key(tmp_path / "good"))]
    assert main(["--profile", "nowhere", *good, "--bus", "crane0=wire:none"]) == 3
    assert main(["--profile", "palms_471", *good, "--bus", "crane0=wire:none"]) == 4
    assert main(["--profile", "palms_471", *good, "--rate", "7"]) == 3
    key = tmp_path / "key"
    key.write_bytes(b"short")
    assert main(["--profile", "palms_471", "--setpoint-port", "0", "--key-file", str(key)]) == 3
    assert main(["--profile", "palms_471", "--setpoint-port", "0", "--key-file", str(key) + "x"]) == 3
    for arguments in (
        [*good, "--bus", "x=wire:x"],
        [*good, "--report", "nowhere"],
        [*good, "--guard-not-needed"],
        good[:2],
    ):
        with pytest.raises(SystemExit) as stopped:
            main(["--profile", "palms_471", *arguments])
        assert stopped.value.code == 2
    palms = ["--profile", "palms_471", *good, "--bus", "crane0=virtual:start"]
    assert main([*palms, "--bus", "mach0=virtual:x"]) == 3
    assert main([*palms, "--sync-lead-us", "5000"]) == 3
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("controller: ")]
    assert len(errors) == 7


def test_busy_port_is_one_sentence_and_exit_4(capsys, udp, tmp_path):
    port = udp[0].getsockname()[1]
    arguments = ["--profile", "palms_471", "--setpoint-port", str(port), "--bus", "crane0=virtual:busy"]
    arguments += ["--key-file", str(write_key(tmp_path / "key"))]
    assert main(arguments) == 4
    assert port in numbers_in(capsys.readouterr().err)


def test_setpoint_socket_is_on_loopback_only():
    with listen(0) as made:
        assert made.getsockname()[0] == "127.0.0.1"
