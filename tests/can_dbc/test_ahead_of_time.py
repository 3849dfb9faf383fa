"""The typed codecs for the compiler give what the codecs of the interpreter give, here run as plain Python."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Any

import pytest

from can_dbc.dbc import codegen
from can_dbc.dbc.ahead_of_time import module_source
from can_dbc.dbc.codec import SHIPPED, MessageCodec, compile_one, load, parse
from can_dbc.dbc.codegen import key_of

CODECS = [codec for name in SHIPPED for codec in load(name).messages.values()]
UNUSUAL = (None, math.nan, math.inf, -math.inf, -0.0, 1e300, 10**30, 2**53 + 1, True, "7", 0.5, 2.5)


@pytest.fixture(scope="module")
def classes() -> dict[str, Any]:
    # As a Python int a word has no sign.
    space: dict[str, Any] = {"__name__": "generated"}
    exec(module_source(CODECS).replace('Struct("<q")', 'Struct("<Q")'), space)
    found: dict[str, Any] = space["CODECS"]
    return found


def compiled(codec: MessageCodec, classes: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> MessageCodec:
    """The same message, made while the classes are there."""
    path = next(load(name).path for name in SHIPPED if codec.name in load(name).messages)
    monkeypatch.setattr(codegen, "AHEAD_OF_TIME", classes)
    return compile_one(parse(path).get_message_by_name(codec.name), path)


def outcome(function: Callable[..., Any], *arguments: object) -> tuple[str, ...]:
    try:
        return (repr(function(*arguments)),)
    except (ValueError, TypeError, OverflowError) as error:
        return type(error).__name__, str(error)


def test_all_shipped_messages_are_covered_but_those_longer_than_a_frame(classes: dict[str, Any]) -> None:
    assert {codec.name for codec in CODECS if key_of(codec.source) not in classes} == {
        codec.name for codec in CODECS if codec.length > 8
    }


@pytest.mark.parametrize("name", ["EncSlew", "EncTilt", "ValveFbA", "EEC1", "GuardStat", "CtrlStatus", "ValveCmdA"])
def test_they_agree_with_the_interpreters_codecs(
    name: str, classes: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    codec = next(codec for codec in CODECS if codec.name == name)
    other = compiled(codec, classes, monkeypatch)
    assert other.receive != codec.receive and other.source == codec.source
    rng = random.Random(name)
    for _ in range(1500):
        data = rng.randbytes(codec.length if rng.random() < 0.95 else rng.randrange(9))
        data = bytes(rng.choice((0, 1, 127, 128, 255)) for _ in data) if rng.random() < 0.3 else data
        assert outcome(codec.receive, data) == outcome(other.receive, data)
        if len(data) != codec.length:
            continue
        values = list(codec.decode(data))
        for i, s in enumerate(codec.signals):
            choice = rng.random()
            if choice < 0.1:
                values[i] = rng.choice((*UNUSUAL, s.minimum, s.maximum))
            elif choice < 0.5:
                values[i] = rng.choice((values[i], s.minimum or 0, s.maximum or 0))
                values[i] += rng.choice((0.5, -0.5, 1e-7, -1e-7, 1e-6, rng.uniform(-1, 1))) * s.scale
        assert outcome(codec.encode, *values) == outcome(other.encode, *values), values
