"""Recordings of a machine that stops: a real controller in virtual time loses an encoder while the crane moves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from can_dbc.messages.crane import OperatorAction
from controller.process.tick_recording import record
from machine.status.modes import Mode
from recorder.manifest import describe
from recorder.recorder import Recorder
from tests.controller.bench import PROFILE, Bench


class RecordedBench(Bench):
    """A bench whose every tick is recorded, with the frames that it received."""

    def __init__(self, recorders: list[Recorder]) -> None:
        super().__init__()
        self.recorders = recorders

    def tick_with(self, *datagrams, **measured):
        outputs = super().tick_with(*datagrams, **measured)
        data = record(self.inputs, outputs, self.now_ns)
        for recorder in self.recorders:
            recorder.on_tick(data)
            if self.count % 20 == 0:
                recorder.flush(self.now_ns)
        return outputs

    def arm_again(self) -> None:
        """RESET and ARM, and the crane moves again."""
        self.dropped.clear()
        self.run(20)
        self.tick([self.operator(OperatorAction.RESET)])
        self.run(20)
        self.tick([self.operator(OperatorAction.ARM)])
        assert self.mode is Mode.ARMED, self.reason
        self.tick([self.hold()])
        self.drive(0, 0.08, 20)

    def close(self) -> None:
        """End the recordings."""
        for recorder in self.recorders:
            recorder.close()

    def lose(self, message: str, ticks: int) -> None:
        """The message is not received any more; the planner goes on."""
        self.dropped.add(message)
        for k in range(ticks):
            self.tick([self.moving(0, 0.08)] if k % 10 == 0 and self.mode is Mode.ACTIVE else ())


def recorder_in(directory: Path, live: bool = False, **options) -> Recorder:
    return Recorder(directory, PROFILE, describe(PROFILE, ("crane0",), seed=3, live=live), sync=False, **options)


def run_to_a_stop(directory: Path, before: int = 600, after: int = 1200, **options) -> RecordedBench:
    """A run below ``directory`` that goes on: ``before`` ticks of motion, EncLift lost, and ``after`` ticks."""
    bench = RecordedBench([recorder_in(directory, **options)])
    bench.active(ticks=before)
    if after:
        bench.lose("EncLift", after)
    return bench


def run_with_a_stop(
    directory: Path, after: int = 1200, then: Callable[[RecordedBench], None] | None = None, **options
) -> RecordedBench:
    """The same, ended: 3 s of motion."""
    bench = run_to_a_stop(directory, after=after, **options)
    if then is not None:
        then(bench)
    bench.close()
    return bench
