"""The interpreter is the reference: the compiled tick gives the same bytes on recorded and on random ticks."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from can_dbc.dbc.codec import load
from can_dbc.messages import tick_record
from can_dbc.messages.tick_record import TickRecord
from controller.config import load as load_settings
from controller.process.tick_recording import restore_inputs, transmitted
from controller.step import Controller, step
from controller.tick import Inputs
from hil.tick.compare import kept_recordings
from hil.tick.random_ticks import RandomTicks
from hil.tick.worker import digest_of, recorded
from runtime.compiled import SWITCH
from tests.hil.compiled_tick import build_key

DATABASES = load("crane"), load("machine"), load("gnss")


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {path.parent.name: path for path in kept_recordings(tmp_path_factory.mktemp("kept"))}


@pytest.fixture(scope="module")
def build() -> str:
    return build_key()


class Worker:
    """The compiled tick in a process of its own."""

    def __init__(self, profile: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "hil.tick.worker", "pipe", profile],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={k: v for k, v in os.environ.items() if k != SWITCH},
        )
        assert self.process.stdin and self.process.stdout
        self.input, self.output = self.process.stdin, self.process.stdout
        self.kind = self.output.readline().decode().split()[0]

    def restart(self) -> None:
        self.input.write(struct.pack("<I", 0))

    def digest(self, tick: TickRecord) -> bytes:
        data = tick_record.encode(tick)
        self.input.write(struct.pack("<I", len(data)) + data)
        self.input.flush()
        return self.output.read(32)


@pytest.fixture(scope="module", params=["palms", "aoro"])
def side_by_side(
    request: pytest.FixtureRequest, recordings: dict[str, Path], build: str
) -> Iterator[tuple[Worker, str, list[TickRecord]]]:
    settings_, ticks = recorded(recordings[request.param], 0)
    worker = Worker(settings_.profile.name)
    yield worker, settings_.profile.name, ticks
    worker.process.kill()
    worker.process.wait()


@pytest.mark.timeout(900)
@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32), start=st.integers(0, 1200), length=st.integers(1, 250))
def test_random_ticks_give_the_same_bytes_on_the_interpreter_and_compiled(
    side_by_side: tuple[Worker, str, list[TickRecord]], seed: int, start: int, length: int
) -> None:
    worker, profile, ticks = side_by_side
    assert worker.kind == "compiled"
    worker.restart()
    controller, inputs = Controller(load_settings(profile), DATABASES[0], DATABASES[1:]), Inputs()
    supply = RandomTicks(ticks[start : start + length], DATABASES, seed)
    for tick in (*islice(ticks, 0, start, 4), *supply.one_pass()):
        given_ = replace(tick, frames_out=(), machine_frames_out=(), report=b"", vehicle_report=b"")
        restore_inputs(inputs, tick)
        assert digest_of(transmitted(step(controller, inputs, tick.now_ns))) == worker.digest(given_)
