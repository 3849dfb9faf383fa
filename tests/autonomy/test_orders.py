"""The gate of a person's orders: only what is fresh, in order, for this machine and signed."""

from __future__ import annotations

from dataclasses import replace

import pytest

from autonomy.process.operator_commands import AGE_NS, OrderRefused, Orders
from can_dbc.mission_datagrams import MissionOrder, Order, encode_order
from can_dbc.setpoint import OperatorAction, OperatorCommand, encode

NOW_NS = 10**12
PAUSE = MissionOrder(5, 77, NOW_NS, Order.PAUSE)


def test_an_order_is_taken_once() -> None:
    orders = Orders(77)
    assert orders.take(encode_order(PAUSE), NOW_NS) == PAUSE
    with pytest.raises(OrderRefused, match="given before"):
        orders.take(encode_order(PAUSE), NOW_NS)
    later = replace(PAUSE, sequence=6, order=Order.AUTO)
    assert orders.take(encode_order(later), NOW_NS) == later
    with pytest.raises(OrderRefused, match="given before"):
        orders.take(encode_order(PAUSE), NOW_NS)


def test_an_old_order_is_refused_and_one_from_the_future() -> None:
    orders = Orders(77)
    with pytest.raises(OrderRefused, match=r"1\.5 s old"):
        orders.take(encode_order(PAUSE), NOW_NS + 1_500_000_000)
    with pytest.raises(OrderRefused, match="future"):
        orders.take(encode_order(PAUSE), NOW_NS - 1)
    assert orders.take(encode_order(PAUSE), NOW_NS + AGE_NS) == PAUSE, "a refused one does not count as given"


def test_another_machines_order_is_refused() -> None:
    with pytest.raises(OrderRefused, match="another profile"):
        Orders(78).take(encode_order(PAUSE), NOW_NS)


def test_with_a_key_only_signed_orders_count() -> None:
    orders = Orders(77, b"right")
    for wrong in (encode_order(PAUSE), encode_order(PAUSE, b"wrong")):
        with pytest.raises(OrderRefused, match="refused"):
            orders.take(wrong, NOW_NS)
    assert orders.take(encode_order(PAUSE, b"right"), NOW_NS) == PAUSE


@pytest.mark.parametrize("data", [b"", b"pause", encode(OperatorCommand(1, 77, NOW_NS, OperatorAction.ARM))])
def test_what_is_no_order_is_refused(data: bytes) -> None:
    with pytest.raises(OrderRefused):
        Orders(77).take(data, NOW_NS)
