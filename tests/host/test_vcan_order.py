"""The order of the vcan lab to its guest, the kernel command line, interface names."""

from __future__ import annotations

from dataclasses import replace

import pytest

from host.vcan_lab.spec import LabError, Request, kernel_arguments, link_fault, order
from tests.codes import coded
from tests.host.vcan_request import REQUEST


def test_the_order_contains_the_caller_and_the_lab() -> None:
    text = order(REQUEST, "uml", new_links=True)
    assert text["user"] == [1000, 100, [100, 4]]
    assert text["links"] == ["vcan0", "vcan1"]
    assert text["env"] == {"A": "b", "TIMBERHAND_LAB": "uml", "XDG_RUNTIME_DIR": "/dev/runtime"}
    assert not text["host_shm"]
    assert order(replace(REQUEST, root=True), "uml", new_links=True)["user"] is None


def test_existing_interfaces_are_not_created_again() -> None:
    assert order(REQUEST, "native", new_links=False)["links"] == []


@pytest.mark.parametrize(
    ("request_", "needed"),
    [
        (replace(REQUEST, cwd="/dev/shm/x"), []),
        (replace(REQUEST, argv=("ls", "/dev/shm")), []),
        (replace(REQUEST, env={"TMPDIR": "/dev/shm/t"}), []),
        (REQUEST, ["/dev/shm/venv"]),
    ],
)
def test_needed_files_in_shared_memory_stay_visible(request_: Request, needed: list[str]) -> None:
    assert order(request_, "uml", True, needed)["host_shm"]


def test_an_odd_path_stays_one_word_of_the_kernel_command_line() -> None:
    arguments = kernel_arguments("/a b/python", "/c d", REQUEST, 5, 6, 7)
    assert 'init="/a b/python"' in arguments
    assert arguments[-1] == '"/c d"'
    assert {"mem=256M", "con1=null,fd:5", "con2=null,fd:6", "con3=fd:7"} <= set(arguments)
    assert arguments.index("--") > arguments.index('init="/a b/python"')


def test_simulated_time_begins_at_the_same_instant_in_every_run() -> None:
    wanted = {"time-travel=inf-cpu", "time-travel-start=1767225600000000000"}
    assert not wanted & set(kernel_arguments("/python", "/", REQUEST, 5, 6, 7))
    arguments = kernel_arguments("/python", "/", replace(REQUEST, time_travel=True), 5, 6, 7)
    assert wanted <= set(arguments[: arguments.index("--")])


def test_a_path_with_a_quote_is_refused() -> None:
    with pytest.raises(LabError, check=coded("lab.path")):
        kernel_arguments('/a"b/python', "/", REQUEST, 5, 6, 7)


@pytest.mark.parametrize("name", ["", "sixteen-letters-", "a b", "a/b", "a:b", ".."])
def test_an_impossible_interface_name_is_refused(name: str) -> None:
    assert link_fault(name)


def test_a_valid_interface_name_is_accepted() -> None:
    assert link_fault("fifteen-letters") is None
