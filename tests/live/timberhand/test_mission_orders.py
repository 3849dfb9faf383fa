"""Orders to a planner over a real socket."""

from __future__ import annotations

import threading

import pytest

from can_dbc.messages.mission import MissionAction
from host.exit_codes import CommandFailed, ExitCode
from tests.codes import coded
from tests.operator_end import udp_end
from timberhand import mission_orders


def test_what_comes_back_is_received_until_nothing_more_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mission_orders, "ANSWER_S", 0.5)
    with udp_end(5) as planner:

        def answer() -> None:
            data, sender = planner.recvfrom(100)
            for part in (b"1", b"2"):
                planner.sendto(data + part, sender)

        thread = threading.Thread(target=answer)
        thread.start()
        assert list(mission_orders.exchange(planner.getsockname()[1], b"order")) == [b"order1", b"order2"]
        thread.join()


def test_a_port_at_which_nobody_listens_is_named() -> None:
    with udp_end(None) as free:
        port = free.getsockname()[1]
    with pytest.raises(CommandFailed, check=coded("mission.no-planner")) as refused:
        mission_orders.PlannerOrders(port, 1, None).order(MissionAction.PAUSE)
    assert refused.value.exit_code == ExitCode.BUS
