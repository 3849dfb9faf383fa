"""The physics client: it caches functions, but never beyond its own lifetime."""

from __future__ import annotations

import pybullet
import pytest

from sim.bullet.client import new_client


def test_a_closed_client_does_not_reach_a_later_one():
    first = new_client()
    assert first.getNumBodies() == 0
    number = first._client
    first.disconnect()
    second = new_client()
    try:
        assert second._client == number  # Bullet reuses it
        with pytest.raises(pybullet.error):
            first.getNumBodies()
    finally:
        second.disconnect()


def test_two_clients_do_not_share_cached_functions():
    one, other = new_client(), new_client()
    try:
        one.createMultiBody(1.0, one.createCollisionShape(one.GEOM_SPHERE, radius=0.1))
        assert (one.getNumBodies(), other.getNumBodies()) == (1, 0)
    finally:
        one.disconnect()
        other.disconnect()
