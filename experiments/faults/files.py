"""Catalogue entries on real files and clocks: the wall clock, a full disk, a power cut, malformed missions.

Each check is one random injection with the outcome of an injection in a run, so that all entries are judged alike.
Durations are processor time: how long a busy host takes says nothing about the code.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any, Final

from autonomy.calibration.profile_file import write_profile
from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import MissionError
from can_dbc.bus.receive_clock import ReceiveClock
from can_dbc.frame import Frame
from controller.guard.__main__ import profile_path
from experiments.common.pool import Job
from experiments.common.result import ROOT
from experiments.common.worlds import profile_named
from experiments.faults.trial import in_child
from hil.faults.catalogue import CASES
from machine.loading.profile_file import ProfileError, load_profile
from recorder.manifest import describe
from recorder.recorder import Recorder
from recorder.recover import Stored, recover, run_files, scan

MS: Final = 1_000_000
T_NS: Final = 5 * MS
HOUR_NS: Final = 3_600_000_000_000
MISSIONS: Final = ROOT / "docs" / "examples"
SITE: Final = (63.6577, 19.8952)
"""Latitude and longitude [deg] of the machine, within the mission that is malformed."""
COMMIT_NS: Final = 100 * MS
"""The recorder's process writes this often (`recorder.__main__`)."""
FRAME: Final = (0x183, bytes(8))


def perform(job: Job) -> dict[str, Any]:
    """Make all injections of one case; options: case, count."""
    case = CASES[job.options["case"] - 1]
    check = CHECKS[case.name]
    outcomes = []
    for i in range(job.options["count"]):
        seed = f"{case.name} {job.seed} {i}"
        outcomes.append(in_child(lambda seed=seed: check(Random(seed)) | {"seed": seed}))  # type: ignore[misc]
    return {"case": case.number, "scene": "files", "outcomes": outcomes}


def _outcome(what: str, bound_ms: float, found_ms: float | None, good: bool, said: str) -> dict[str, Any]:
    late = found_ms is not None and found_ms > bound_ms
    verdict = "ok" if good and not late else "late" if good else "undetected"
    return {
        "at_ms": 0.0,
        "orders": [what],
        "expected": "REFUSED",
        "bound_ms": bound_ms,
        "seen_ms": 0.0,
        "tip_limit_m": None,
        "reached": {},
        "reason": "",
        "refused_ms": found_ms,
        "neutral_ms": None,
        "valves_ms": None,
        "travel_m": 0.0,
        "astray_m": 0.0,
        "standing": True,
        "timeline": [[found_ms or 0.0, said]],
        "detect_ms": found_ms,
        "verdict": verdict,
        "missed": verdict != "ok",
    }


def wall_clock(random: Random) -> dict[str, Any]:
    """Send frames of two seconds through the receive clock, while the wall clock is stepped at random moments."""
    now_ns = 100_000_000_000
    clock, wall_offset_ns = ReceiveClock(now_ns), 1_700_000_000 * 1_000_000_000
    worst_ns, future, steps = 0, 0, []
    waiting: list[tuple[int, int]] = []
    for tick in range(400):
        tick_ns = now_ns + tick * T_NS
        for k in range(4):
            true_ns = tick_ns - T_NS + 1 + k * T_NS // 4
            waiting.append((true_ns, true_ns + wall_offset_ns))
            if random.random() < 0.005:
                step_ns = random.choice((-1, 1)) * random.randrange(HOUR_NS)
                wall_offset_ns += step_ns
                steps.append(step_ns)
        clock.begin(tick_ns, tick_ns + wall_offset_ns)
        for true_ns, stamp_ns in waiting:
            receive_ns = stamp_ns + clock.offset_ns
            if not clock.since_ns <= receive_ns <= clock.now_ns:
                receive_ns = clock.doubtful_ns(stamp_ns)
            future += receive_ns > tick_ns
            worst_ns = max(worst_ns, abs(receive_ns - true_ns))
        waiting.clear()
        clock.emptied()
    good = worst_ns <= 2 * T_NS and not future
    sentence = f"{len(steps)} steps of up to one hour; a frame looked at most {worst_ns / MS:.2f} ms older than it was"
    return _outcome("wall clock stepped", 0.0, None, good, sentence)


def _recorder(folder: Path) -> Recorder:
    profile = profile_named("palms_471")
    return Recorder(folder, profile, describe(profile, (profile.crane_bus,), 0))


def disk_full(random: Random) -> dict[str, Any]:
    """Let no file grow beyond a random size from a random moment on, as on a full disk."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    with tempfile.TemporaryDirectory() as folder:
        recorder = _recorder(Path(folder) / "run")
        full_ns, noticed_ns = random.randrange(200, 1500) * MS, None
        limited = False
        for now_ns in range(0, 4000 * MS, T_NS):
            if not limited and now_ns >= full_ns:
                limited = True
                resource.setrlimit(resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
            for k in range(10):
                recorder.on_frame("crane0", Frame(now_ns + k, *FRAME))
            if now_ns % COMMIT_NS == 0:
                recorder.flush(now_ns)
            if limited and recorder.dropped and noticed_ns is None:
                noticed_ns = now_ns
        recorder.close()
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    found_ms = None if noticed_ns is None else (noticed_ns - full_ns) / MS
    sentence = (
        f"disk full at {full_ns / MS:.0f} ms; {recorder.dropped} lost records counted, no error reached the caller"
    )
    return _outcome("disk full", 1000.0, found_ms, found_ms is not None, sentence)


def power_cut(random: Random) -> dict[str, Any]:
    """Let the power fail while a recording or a profile is written."""
    return _recording_cut(random) if random.random() < 0.5 else _profile_cut(random)


def _profile_cut(random: Random) -> dict[str, Any]:
    """Kill a process that writes calibrated profiles at a random moment; every profile there must be whole."""
    with tempfile.TemporaryDirectory() as folder:
        child = os.fork()
        if child == 0:
            for i in range(10_000):
                write_profile(profile_path("palms_471"), Path(folder) / f"p{i}.toml", [], "2000-01-01")
            os._exit(0)
        while not any(Path(folder).glob("p*.toml")):
            time.sleep(0.01)
        time.sleep(random.uniform(0.0, 0.3))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        begin, whole, broken = time.process_time(), 0, 0
        for path in sorted(Path(folder).glob("p*.toml")):
            try:
                load_profile(path)
                whole += 1
            except ProfileError:
                broken += 1
        found_ms = 1e3 * (time.process_time() - begin) / max(1, whole + broken)
    sentence = f"{whole} whole profiles, {broken} broken"
    return _outcome("profile cut", 2000.0, round(found_ms, 3), not broken, sentence)


def _recording_cut(random: Random) -> dict[str, Any]:
    """Cut a recording at a random byte; what was committed over 250 ms before that byte must be read back."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        recorder = _recorder(run)
        commits: list[tuple[int, int]] = []
        for now_ns in range(0, 3000 * MS, T_NS):
            for k in range(10):
                recorder.on_frame("crane0", Frame(now_ns + k, FRAME[0], random.randbytes(8)))
            if now_ns % COMMIT_NS == 0:
                recorder.flush(now_ns)
                commits.append((run_files(run)[0].stat().st_size, now_ns))
        recorder.close()
        path = run_files(run)[0]
        cut_byte = random.randrange(commits[0][0], path.stat().st_size)
        data = path.read_bytes()[:cut_byte]
        path.write_bytes(data)
        begin = time.process_time()
        recover(run)
        found_ms = 1e3 * (time.process_time() - begin)
        last_ns = max(
            (r.log_ns for f in run_files(run) for r in scan(f, {"/crane0/raw"}) if isinstance(r, Stored)), default=-1
        )
    committed_ns = max((ns for size, ns in commits if size <= cut_byte), default=0)
    good = last_ns >= committed_ns - 250 * MS
    sentence = (
        f"cut at byte {cut_byte}; written until {committed_ns / MS:.0f} ms, read back until {last_ns / MS:.0f} ms"
    )
    return _outcome("recording cut", 2000.0, found_ms, good, sentence)


def _swapped(random: Random) -> bytes:
    document = json.loads((MISSIONS / "paper_b.geojson").read_text())

    def swap(value: Any) -> Any:
        if isinstance(value, list) and len(value) >= 2 and all(isinstance(v, int | float) for v in value[:2]):
            return [value[1], value[0], *value[2:]]
        if isinstance(value, list):
            return [swap(v) for v in value]
        return {k: swap(v) for k, v in value.items()} if isinstance(value, dict) else value

    return json.dumps(swap(document)).encode()


def _not_a_number(random: Random) -> bytes:
    text = (MISSIONS / "paper_b.geojson").read_text()
    document = json.loads(text)
    points = [f for f in document["features"] if f["geometry"]]
    geometry = random.choice(points)["geometry"]
    at = geometry["coordinates"]
    while isinstance(at[0], list):
        at = random.choice(at)
    at[0] = random.choice((float("nan"), float("inf")))
    return json.dumps(document).encode()


def _entity(random: Random) -> bytes:
    text = (MISSIONS / random.choice(("route.gpx", "site.kml"))).read_text()
    head, _, rest = text.partition("?>")
    evil = '<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/passwd">]>'
    return (head + "?>" + evil + rest).encode()


def _many(random: Random) -> bytes:
    line = {"type": "LineString", "coordinates": [[10.0, 60.0 + 1e-7 * i] for i in range(300_000)]}
    feature = {"type": "Feature", "geometry": line, "properties": {"role": "route"}}
    return json.dumps({"type": "FeatureCollection", "features": [feature]}).encode()


def _cut(random: Random) -> bytes:
    data = (
        MISSIONS / random.choice(("paper_b.geojson", "route.gpx", "route.plan", "site.kml", "harvest.hpr"))
    ).read_bytes()
    return data[: random.randrange(1, len(data) * 9 // 10)]


MALFORMED: Final[tuple[Callable[[Random], bytes], ...]] = (_swapped, _not_a_number, _entity, _many, _cut)


def mission(random: Random) -> dict[str, Any]:
    """Read a mission file that must be refused, within a second, by a sentence with its file."""
    make = random.choice(MALFORMED)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mission"
        path.write_bytes(make(random))
        begin = time.process_time()
        try:
            load_mission(path, site=SITE)
            refused = ""
        except MissionError as error:
            refused = f"{error.code}: {str(error)[:160]}".replace(folder, "")
        found_ms = round(1e3 * (time.process_time() - begin), 3)
    return _outcome(make.__name__.strip("_"), 1000.0, found_ms, bool(refused), refused or "accepted")


CHECKS: Final[dict[str, Callable[[Random], dict[str, Any]]]] = {
    "wall-clock": wall_clock,
    "disk-full": disk_full,
    "power-cut": power_cut,
    "malformed-mission": mission,
}
