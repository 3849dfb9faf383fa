"""The GNSS receiver on virtual time: geodesy against pymap3d, frames against the nmea2000 package, noise, faults."""

from __future__ import annotations

import datetime
import itertools
import math
import statistics
from collections import defaultdict

import msgspec
import pymap3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nmea2000.decoder import NMEA2000Decoder

from can_dbc.dbc.codec import load
from can_dbc.frame import identifier
from can_dbc.protocols.nmea2000 import Receiver, split_id
from machine.loading.profile_file import load_profile
from sim.geometry import LocalFrame, rpy_quaternion
from sim.nodes.gnss import Fix, GnssNode
from sim.truth.load import load_truth

CARRIER = load_profile("aoro_fc8").carrier
TRUTH = load_truth("nominal", 0, "aoro_fc8").gnss
MACHINE, GNSS = load("machine"), load("gnss")
STEP_NS = 2_500_000
START_NS = 1_000_000_000
assert CARRIER is not None and TRUTH is not None
QUIET = msgspec.structs.replace(
    TRUTH,
    fixes={n: msgspec.structs.replace(f, noise_m=0.0, wander_m=0.0) for n, f in TRUTH.fixes.items()},
    phase_noise_m=0.0,
    speed_noise_m_s=0.0,
    rate_noise_rad_s=0.0,
    attitude_noise_rad=0.0,
)


# -- geodesy ---------------------------------------------------------------------------------------------------


@settings(max_examples=200, deadline=None)
@given(
    st.floats(-89.9, 89.9),
    st.floats(-180.0, 180.0),
    st.floats(-50.0, 3000.0),
    st.floats(-1000.0, 1000.0),
    st.floats(-1000.0, 1000.0),
    st.floats(-20.0, 20.0),
)
def test_local_metres_agree_with_pymap3d(lat, lon, height, east, north, up):
    mine = LocalFrame(lat, lon, height).geodetic(east, north, up)
    back = pymap3d.geodetic2enu(*mine, lat, lon, height)
    assert back == pytest.approx((east, north, up), abs=1e-3)
    theirs = pymap3d.enu2geodetic(east, north, up, lat, lon, height)
    assert mine[0] == pytest.approx(float(theirs[0]), abs=1e-9) and mine[2] == pytest.approx(float(theirs[2]), abs=1e-3)


# -- the receiver ----------------------------------------------------------------------------------------------


class Bench:
    """A receiver on a front half that moves as ``pose(seconds)`` says; readings are kept by message name."""

    def __init__(self, pose=None, truth=QUIET, seed=0) -> None:
        self.out: list[tuple[int, bytes]] = []
        self.now_ns = START_NS
        place = pose or (lambda _: ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        self.node = GnssNode(
            MACHINE, GNSS, self.out, CARRIER, truth, seed, lambda: place((self.now_ns - START_NS) * 1e-9)
        )
        self.sent: list[tuple[int, int, bytes]] = []
        self.readings: dict[str, list[dict]] = defaultdict(list)
        self.receiver = Receiver(GNSS)

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds * 1e9 / STEP_NS)):
            self.node.tick(self.now_ns)
            for key, data in self.out:
                self.sent.append((self.now_ns, key, data))
                if reading := self.receiver.receive(key, data, self.now_ns):
                    self.readings[reading.codec.name].append(reading.fields)
            self.out.clear()
            self.now_ns += STEP_NS

    def last(self, name: str) -> dict:
        return self.readings[name][-1]

    def places(self) -> list[tuple[float, float]]:
        """East and north of every position, by pymap3d."""
        origin = (CARRIER.site_lat_deg, CARRIER.site_lon_deg, TRUTH.datum_m)
        height = TRUTH.datum_m + CARRIER.antenna_main_m[2]
        readings = [(r["Latitude"], r["Longitude"]) for r in self.readings["PositionRapidUpdate"]]
        return [tuple(float(v) for v in pymap3d.geodetic2enu(*p, height, *origin)[:2]) for p in readings]


def driving(speed=0.6, turn=0.1):
    """A left-hand circle about a point north of the origin."""

    def pose(t):
        psi = turn * t
        radius = speed / turn
        return (radius * math.sin(psi), radius * (1.0 - math.cos(psi)), 0.0), rpy_quaternion(0.05, -0.02, psi)

    return pose


def test_every_message_comes_at_its_period_and_the_nmea2000_package_reads_it():
    bench = Bench(driving(), TRUTH)
    bench.wait(10.0)
    decoder = NMEA2000Decoder()
    theirs = defaultdict(list)
    for ns, key, data in bench.sent:
        message = decoder.decode(f"({ns / 1e9:.6f}) can0 {identifier(key):08X}#{data.hex().upper()}")
        if message is not None:
            theirs[message.PGN].append({f.id: f.value for f in message.fields})
    expected = {129025: 100, 127250: 100, 127251: 100, 127257: 100, 129026: 40, 126992: 10, 129029: 10, 60928: 1}
    assert {pgn: len(found) for pgn, found in theirs.items()} == {
        pgn: pytest.approx(n, abs=1) for pgn, n in expected.items()
    }
    rapid, full = theirs[129025][-1], theirs[129029][-1]
    ours = bench.last("PositionRapidUpdate")
    assert rapid["latitude"] == pytest.approx(ours["Latitude"], abs=1e-9)
    assert rapid["longitude"] == pytest.approx(ours["Longitude"], abs=1e-9)
    assert full["altitude"] == pytest.approx(TRUTH.datum_m + CARRIER.antenna_main_m[2], abs=0.2)
    assert full["method"] == "RTK Fixed Integer" and full["numberOfSvs"] == 19 and full["hdop"] == pytest.approx(0.7)
    assert theirs[127250][-1]["heading"] == pytest.approx(bench.last("VesselHeading")["Heading"], abs=1e-6)
    assert theirs[127250][-1]["reference"] == "True"
    assert theirs[126992][-1]["date"] == datetime.date(2026, 6, 1)
    assert bench.receiver.reassembler.lost == 0
    firsts = [d[0] for _, key, d in bench.sent if split_id(key).pgn == 129029 and d[0] & 0x1F == 0]
    assert [f >> 5 for f in firsts] == [i % 8 for i in range(len(firsts))]


def test_position_is_that_of_the_true_main_antenna():
    moved = msgspec.structs.replace(QUIET, main_offset_m=(0.03, -0.02, 0.0), aux_offset_m=(0.03, -0.02, 0.0))
    for psi in (0.0, 1.0, -2.5):
        pose = ((10.0, -4.0, 0.3), rpy_quaternion(0.1, 0.0, psi))
        bench = Bench(lambda _, pose=pose: pose, moved)
        bench.wait(0.5)
        x, y, z = (a + b for a, b in zip(CARRIER.antenna_main_m, moved.main_offset_m, strict=True))
        y, z = y * math.cos(0.1) - z * math.sin(0.1), y * math.sin(0.1) + z * math.cos(0.1)
        east, north = 10.0 + x * math.cos(psi) - y * math.sin(psi), -4.0 + x * math.sin(psi) + y * math.cos(psi)
        assert bench.places()[-1] == pytest.approx((east, north), abs=0.008)
        heading = bench.last("VesselHeading")["Heading"]
        assert math.remainder(heading - (math.pi / 2 - psi), math.tau) == pytest.approx(0.0, abs=2e-3)


def test_misplaced_antennas_turn_the_heading():
    askew = msgspec.structs.replace(QUIET, aux_offset_m=(0.0, 0.03, 0.0))
    bench = Bench(None, askew)
    bench.wait(0.5)
    baseline = math.dist(CARRIER.antenna_main_m, CARRIER.antenna_aux_m)
    assert math.pi / 2 - bench.last("VesselHeading")["Heading"] == pytest.approx(math.atan(0.03 / baseline), abs=2e-4)


def test_the_heading_does_not_depend_on_the_antennas_layout():
    swapped = msgspec.structs.replace(CARRIER, antenna_main_m=CARRIER.antenna_aux_m, antenna_aux_m=(0.4, 1.0, 2.0))
    out: list[tuple[int, bytes]] = []
    pose = ((0.0, 0.0, 0.0), rpy_quaternion(0.0, 0.0, 0.5))
    node = GnssNode(MACHINE, GNSS, out, swapped, QUIET, 0, lambda: pose)
    for i in range(100):
        node.tick(START_NS + i * STEP_NS)
    heading = GNSS.message("VesselHeading").receive(next(d for k, d in out if split_id(k).pgn == 127250))[1]
    assert heading == pytest.approx(math.pi / 2 - 0.5, abs=1e-4)


def test_motion_is_clockwise_and_roll_is_right_side_down():
    bench = Bench(driving(0.6, 0.1))
    bench.wait(8.0)
    assert bench.last("RateOfTurn")["Rate"] == pytest.approx(-0.1, abs=1e-3)
    course = bench.last("CogSogRapidUpdate")
    # the antenna leads the axis by its lever arm
    assert course["Sog"] == pytest.approx(math.hypot(0.6, 0.1 * CARRIER.antenna_main_m[0]), abs=0.02)
    assert math.remainder(course["Cog"] - bench.last("VesselHeading")["Heading"], math.tau) == pytest.approx(
        0.0, abs=0.1
    )
    attitude = bench.last("Attitude")
    assert (attitude["Roll"], attitude["Pitch"]) == (pytest.approx(0.05, abs=1e-3), pytest.approx(0.02, abs=1e-3))


def test_a_solution_is_fifty_to_a_hundred_milliseconds_old():
    speed = 10.0  # fast, so that age shows as distance
    bench = Bench(lambda t: ((speed * t, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    bench.wait(10.0)
    times = [(ns - START_NS) * 1e-9 for ns, key, _ in bench.sent if split_id(key).pgn == 129025]
    ages = [t - (east - CARRIER.antenna_main_m[0]) / speed for t, (east, _) in zip(times, bench.places(), strict=True)]
    assert 0.048 <= min(ages) < 0.06 and 0.09 < max(ages) <= 0.104


def test_noise_has_the_size_of_the_truth():
    bench = Bench(None, TRUTH)
    bench.wait(60.0)
    places = bench.places()
    errors = [math.dist(p, CARRIER.antenna_main_m[:2]) for p in places]
    steps = [math.dist(a, b) for a, b in itertools.pairwise(places)]
    assert 0.006 < math.sqrt(statistics.fmean(e * e for e in errors)) < 0.022
    assert statistics.quantiles(steps, n=2)[0] > 0.003  # white noise, not only drift
    headings = [math.degrees(r["Heading"]) for r in bench.readings["VesselHeading"]]
    assert 0.11 < statistics.stdev(headings) < 0.26


def test_the_error_wanders_slowly():
    only = {"rtk_fixed": msgspec.structs.replace(TRUTH.fixes["rtk_fixed"], noise_m=0.0, wander_m=1.0)}
    bench = Bench(None, msgspec.structs.replace(TRUTH, fixes=only))
    bench.wait(60.0)
    east = [p[0] for p in bench.places()]
    steps = [b - a for a, b in itertools.pairwise(east)]
    assert max(east) - min(east) > 0.3 and 0.01 < statistics.stdev(steps) < 0.1


def test_a_worse_fix_is_reported_and_is_worse():
    spread = {}
    for fix, method in ((Fix.RTK_FIXED, 4), (Fix.RTK_FLOAT, 5), (Fix.DGNSS, 2), (Fix.SINGLE, 1)):
        bench = Bench(None, TRUTH)
        bench.node.set_fix(fix)
        bench.wait(30.0)
        spread[fix] = max(math.dist(p, CARRIER.antenna_main_m[:2]) for p in bench.places())
        full = bench.last("GnssPositionData")
        quality = TRUTH.fixes[fix.name.lower()]
        assert (full["Method"], full["NumberOfSvs"]) == (method, quality.satellites)
        assert full["Hdop"] == pytest.approx(quality.hdop) and full["Integrity"] == (1 if method == 4 else 2)
    assert spread[Fix.RTK_FIXED] < 0.05 < spread[Fix.RTK_FLOAT] < spread[Fix.DGNSS] < spread[Fix.SINGLE]


def test_no_fix_has_no_position_but_keeps_time():
    bench = Bench()
    bench.wait(1.5)
    bench.node.set_fix(Fix.NONE)
    bench.wait(2.0)
    assert bench.last("PositionRapidUpdate") == {} and "Heading" not in bench.last("VesselHeading")
    assert "Sog" not in bench.last("CogSogRapidUpdate") and "Rate" in bench.last("RateOfTurn")
    full = bench.last("GnssPositionData")
    assert full["Method"] == 0 and not {"Latitude", "Longitude", "Altitude", "Hdop"} & full.keys()
    times = [r["Time"] for r in bench.readings["SystemTime"]]
    assert [b - a for a, b in itertools.pairwise(times)] == [pytest.approx(1.0)] * (len(times) - 1)


def test_faults_of_heading_position_and_power():
    bench = Bench(driving(0.6, 0.2))
    bench.wait(2.0)
    bench.node.heading_frozen = True
    bench.wait(0.5)
    frozen = bench.last("VesselHeading")["Heading"]
    bench.wait(2.0)
    assert bench.last("VesselHeading")["Heading"] == frozen
    bench.node.heading_frozen, bench.node.heading_error_rad = False, math.pi
    bench.wait(0.5)
    true = math.pi / 2 - 0.2 * (bench.now_ns - START_NS) * 1e-9
    assert abs(math.remainder(bench.last("VesselHeading")["Heading"] - true, math.tau)) > 3.0
    bench.node.heading_lost = True
    bench.wait(0.5)
    assert "Heading" not in bench.last("VesselHeading") and "Yaw" not in bench.last("Attitude")
    assert "Latitude" in bench.last("PositionRapidUpdate")
    before = bench.places()[-1]
    bench.node.jump_m = (3.0, -1.0)
    bench.wait(0.3)
    after = bench.places()[-1]
    assert (after[0] - before[0], after[1] - before[1]) == (pytest.approx(3.0, abs=0.4), pytest.approx(-1.0, abs=0.4))
    bench.node.silent = True
    bench.wait(0.1)
    count = len(bench.sent)
    bench.wait(2.0)
    assert len(bench.sent) == count
    bench.node.silent = False
    bench.wait(0.3)
    assert len(bench.sent) > count


def test_only_equal_seeds_give_equal_bytes():
    def run(seed):
        bench = Bench(driving(), TRUTH, seed)
        bench.wait(3.0)
        return bench.sent

    assert run(1) == run(1) != run(2)
