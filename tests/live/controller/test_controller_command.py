"""The controller's command: start errors with their exit codes, addresses, and one run from start to signal."""

import json

from can_dbc.messages.envelope import write_key
from controller.process.command import main
from controller.process.warm_up import NullBus


def test_main_runs_and_ends_by_signal(capsys, monkeypatch, tmp_path):
    """A short run on an in-memory bus, with SIGTERM after some ticks."""
    import signal

    from controller.process import loop as loop_module

    ticks = []
    original = loop_module.Loop.tick

    def tick(self, now_ns, late_ns):
        if isinstance(self.buses[0], NullBus):
            return original(self, now_ns, late_ns)
        ticks.append(now_ns)
        if len(ticks) == 5:
            signal.raise_signal(signal.SIGTERM)
        return original(self, now_ns, late_ns)

    handlers = {n: signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGINT)}
    monkeypatch.setattr(loop_module.Loop, "tick", tick)
    arguments = ["--profile", "palms_471", "--setpoint-port", "0", "--bus", "crane0=virtual:life", "--no-realtime"]
    arguments += ["--key-file", str(write_key(tmp_path / "key"))]
    try:
        assert main(arguments) == 0
    finally:
        import gc

        gc.unfreeze()
        gc.enable()
        for number, handler in handlers.items():
            signal.signal(number, handler)
    captured = capsys.readouterr()
    assert json.loads(captured.out)["ticks"] == 5
    assert all(name in captured.err for name in ("palms_471", "200 Hz", "crane0=virtual:life"))
