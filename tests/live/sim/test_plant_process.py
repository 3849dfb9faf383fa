"""The live plant: frames on a real bus, requests over UDP, clean end, one line per usage mistake."""

from __future__ import annotations

import contextlib
import itertools
import json
import socket
import threading
import time
from math import pi, remainder

import pytest

from can_dbc.bus.factory import open_bus
from can_dbc.dbc.codec import load
from can_dbc.protocols.canopen import NmtCommand, nmt_frame, sync_frame
from machine.geometry.grapple import grapple_yaw
from machine.loading.profile_file import load_profile
from sim.__main__ import main
from sim.plant import Plant
from sim.process.live_plant import LivePlant
from tests.operator_end import udp_end

PROFILE = load_profile("palms_471")
_channels = itertools.count()


def free_port() -> int:
    with udp_end(None) as s:
        return s.getsockname()[1]


@pytest.fixture
def live():
    channel, port = f"virtual:sim{next(_channels)}", free_port()
    plant = Plant(PROFILE, seed=0)
    with open_bus(channel) as far, open_bus(channel) as near, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.settimeout(5.0)
        udp.connect(("127.0.0.1", port))
        shell = LivePlant(plant, {"crane0": near}, port)
        thread = threading.Thread(target=shell.run, daemon=True)
        thread.start()
        yield shell, far, udp, thread
        shell.stop()
        thread.join(5.0)
    plant.close()


def ask(udp: socket.socket, op: str):
    udp.send(json.dumps({"op": op}).encode())
    return json.loads(udp.recv(65536))


def until(far, wanted: set[int]) -> set[int]:
    """Keys received until all wanted ones are there (or ten seconds are over)."""
    frames, seen, end = [], set(), time.monotonic() + 10.0
    while not wanted <= seen and time.monotonic() < end:
        frames.clear()
        far.drain(frames)
        seen |= {f.key for f in frames}
        far.send(*sync_frame(1))
        time.sleep(0.005)
    return seen


def test_sync_is_answered_on_the_bus_after_nmt_start(live):
    _, far, _, _ = live
    far.send(*nmt_frame(NmtCommand.START))
    assert {0x182, 0x185, 0x190, 0x1A0, 0x181, 0x390, 0x490} <= until(
        far, {0x182, 0x185, 0x190, 0x1A0, 0x390, 0x490, 0x181}
    )


def test_requests_read_the_ground_truth_and_press_the_stop(live):
    shell, far, udp, thread = live
    state = ask(udp, "state")
    assert len(state["joints"]) == 5 and len(state["logs"]) == 1 and not state["verdict"]["success"]
    assert state["poses"].keys() >= {"boom", "tong_left"} and len(ask(udp, "shapes")) > 20
    assert ask(udp, "press") == {"ok": True}
    assert 0x181 in until(far, {0x181})
    assert ask(udp, "fly")["error"]
    udp.send(b"[")
    assert json.loads(udp.recv(65536))["error"]
    assert ask(udp, "quit") == {"ok": True}
    thread.join(5.0)
    assert not thread.is_alive() and shell.report()["time_s"] > 0.0


def test_the_total_station_reads_the_pin_with_millimetres_of_noise(live):
    _, _, udp, _ = live
    tip = ask(udp, "state")["tip_m"]
    readings = [ask(udp, "survey")["pin_m"] for _ in range(20)]
    assert all(abs(a - b) < 0.02 for pin in readings for a, b in zip(pin, tip, strict=True))
    assert len({tuple(pin) for pin in readings}) == 20, "every reading has noise of its own"
    mean = [sum(axis) / 20 for axis in zip(*readings, strict=True)]
    assert all(abs(a - b) < 0.003 for a, b in zip(mean, tip, strict=True))


def test_the_total_station_reads_the_grapples_direction_modulo_half_a_turn(live):
    _, _, udp, _ = live
    slew, *_, rot = ask(udp, "state")["joints"]
    along = grapple_yaw(PROFILE, (slew, 0.0, 0.0, 0.0, rot))
    readings = [ask(udp, "survey")["yaw_rad"] for _ in range(20)]
    assert all(0.0 <= yaw < pi for yaw in readings) and len(set(readings)) == 20
    off = [remainder(yaw - along, pi) for yaw in readings]
    assert max(map(abs, off)) < 0.07 and abs(sum(off)) / 20 < 0.015


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--profile", "palms_472", "--bus", "crane0=virtual:x"], 3, "palms_472"),
        (["--bus", "crane9=virtual:x"], 3, "crane9"),
        (["--profile", "aoro_fc8", "--bus", "crane0=virtual:x"], 3, "--bus mach0"),
        (["--bus", "crane0=virtual:x", "--scene", "tower"], 3, "tower"),
        (["--bus", "crane0=virtual:x", "--logs", "90"], 3, ""),
        (["--bus", "crane0=nonsense"], 4, "nonsense"),
    ],
)
def test_a_usage_mistake_gives_one_line_and_an_exit_code(arguments, code, words, capsys):
    assert main(arguments) == code
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1


def test_a_bad_bus_argument_is_a_usage_error(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--bus", "crane0"])
    assert stop.value.code == 2 and "NAME=ADDRESS" in capsys.readouterr().err


def test_a_carrier_runs_on_two_buses_and_answers_requests():
    profile, port = load_profile("aoro_fc8"), free_port()
    channels = {name: f"virtual:{name}-{next(_channels)}" for name in ("crane0", "mach0")}
    plant = Plant(profile, scene=())
    with contextlib.ExitStack() as stack:
        far = {name: stack.enter_context(open_bus(channel)) for name, channel in channels.items()}
        near = {name: stack.enter_context(open_bus(channel)) for name, channel in channels.items()}
        udp = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        udp.settimeout(10.0)
        udp.connect(("127.0.0.1", port))
        shell = LivePlant(plant, near, port)
        thread = threading.Thread(target=shell.run, daemon=True)
        thread.start()
        veh_stat = load("machine").message("VehStat").key
        assert veh_stat in until(far["mach0"], {veh_stat})
        assert {0x190, 0x390} <= until(far["crane0"], {0x190, 0x390})
        assert not until(far["crane0"], {0x190}) & {veh_stat}
        assert ask(udp, "scene")["title"] == profile.title and "rear" in ask(udp, "view")["poses"]
        assert len(ask(udp, "vehicle")["wheel_loads_n"]) == 4
        udp.send(json.dumps({"op": "lever", "name": "drive", "value": "0.5"}).encode())
        assert json.loads(udp.recv(65536)) == {"ok": True}
        for value, words in (("fast", "fast"), ("7", "7")):
            udp.send(json.dumps({"op": "lever", "name": "drive", "value": value}).encode())
            assert words in json.loads(udp.recv(65536))["error"]
        shell.stop()
        thread.join(5.0)
    plant.close()
