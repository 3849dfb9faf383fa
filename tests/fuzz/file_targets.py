"""Files: missions, recordings, traces, databases, profiles, the guard's own readers, and network weights."""

from __future__ import annotations

import contextlib
import gzip
import io
import math
import os
import random
import re
import shutil
import zipfile
from collections.abc import Callable, Hashable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from autonomy import networks
from autonomy.manager.checkpoint import Checkpoint, CheckpointFile, mission_digest, read_checkpoint
from autonomy.manager.tally import Load, LoadedLog, Tally
from autonomy.missions.mission_file import read as read_mission
from autonomy.missions.mission_file import verify
from autonomy.missions.model import ForwardingMission, KnownLog, MissionError, Point
from autonomy.perception.segmentation.segment_merging import QUALITY_NETWORK
from can_dbc.dbc.codec import Database, FrameRefused
from can_dbc.dbc.codec import load as load_dbc
from can_dbc.trace.candump import read_trace
from can_dbc.trace.decoder import Decoder
from can_dbc.trace.records import MalformedRecord
from controller.config import Settings
from controller.config import load as load_settings
from controller.guard.__main__ import build
from controller.guard.envelope import SEAL, digest
from controller.guard.guard import Guard
from controller.guard.layout import GuardConfigError, read_layouts
from machine.draft.from_urdf import answers_from_urdf
from machine.loading.profile_file import load_profile
from recorder.recover import is_complete, recover, scan
from runtime.errors import ConfigError, InputRefused
from sim.draft import crane_urdf
from sim.truth.load import load_truth
from tests.controller.guard_traffic import MOVING, Traffic
from tests.fuzz.engine import Run, Target, coded, in_file, of_file, outcome
from tests.recorder import recordings

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "docs" / "examples"


def other_values(
    seeds: Callable[[], Sequence[bytes]], value: bytes, words: Sequence[bytes]
) -> Callable[[bytes], bytes]:
    """Puts other values into a valid file, which random bytes seldom leave readable; ``value`` is a pattern.

    The input chooses what is changed, so that the same input gives the same file.
    """
    texts: list[tuple[bytes, list[re.Match[bytes]]]] = []

    def changed(data: bytes) -> bytes:
        if not texts:
            every = ((text, list(re.finditer(value, text, re.MULTILINE))) for text in seeds())
            texts.extend((text, found) for text, found in every if len(found) >= 3)  # not those that are packed
        rng = random.Random(data)
        if rng.random() < 0.2:
            return data
        text, found = rng.choice(texts)
        for match in sorted(rng.sample(found, rng.choice((1, 1, 1, 2, 3))), key=lambda m: -m.start()):
            text = text[: match.start(1)] + rng.choice(words) + text[match.end(1) :]
        return text

    return changed


def mission_seeds() -> list[bytes]:
    """The examples, also packed and in UTF-16, and those of the folder of reports, where there is one."""
    plain = [path.read_bytes() for path in sorted(EXAMPLES.glob("*.*")) if path.stat().st_size < 40_000]
    texts = [data.decode().encode("utf-16") for data in plain if data.startswith(b"{")]
    return [*plain, *texts, gzip.compress(plain[0]), *map(zipped, plain[:2]), *reports(*MISSION_SUFFIXES)]


def zipped(data: bytes) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo("doc.kml"), data)
    return made.getvalue()


def reports(*suffixes: str) -> list[bytes]:
    """The small files of public reports with these suffixes, "" of none; nothing where they are not at hand."""
    folder = Path(os.environ.get("TIMBERHAND_DATA", "none")) / "reports"
    found = sorted(folder.iterdir()) if folder.is_dir() else []
    return [path.read_bytes() for path in found if path.suffix in suffixes]


def mission(data: bytes) -> Hashable:
    try:
        draft = read_mission(data, "file")
        verify(draft, site=(63.657853, 19.895562))
    except MissionError as refused:
        coded(refused)
        assert all(p.place.startswith("file") and p.code and "\n" not in p.sentence for p in refused.problems)
        return tuple(p.code for p in refused.problems)[:3]
    return draft.format


def recording_seeds() -> list[bytes]:
    folder = in_file("run.mcap").parent
    recorder = recordings.record(folder, 24)
    with contextlib.suppress(Exception):
        recorder.close()
    whole = (folder / "run.mcap").read_bytes()
    return [whole, whole[: len(whole) * 2 // 3]]


def read_recording(path: Path) -> tuple[Path, int]:
    """The file and the number of its messages before a damage."""
    try:
        return path, sum(1 for _ in scan(path))
    except InputRefused:
        with contextlib.suppress(InputRefused):
            recover(path.parent)
        raise


def repaired(read: tuple[Path, int]) -> Hashable:
    """A damaged recording is repaired to something that can be read whole."""
    path, before = read
    complete = is_complete(path)
    made = recover(path.parent)
    assert bool(made) is not complete
    if made:
        assert is_complete(path) and sum(1 for _ in scan(path)) >= made[0].messages
    return before > 0, complete, bool(made)


MISSION_SUFFIXES = (".gpx", ".kml", ".plan", ".hpr", ".hprz", ".geojson")
TRACES = (
    b"(1700000000.123456) can0 210#0011223344556677\n(1700000000.2) can0 18FF2F27#R\n",
    b"  can0  210   [8]  00 11 22 33 44 55 66 77\n (0.000100)  can0  TX - -  210  [2]  AA BB   '..'\n",
    b"   1)      1059.9  Rx         0210  8  00 11 22 33 44 55 66 77\n",
    b"17:33:21.107 R 19F51323 01 2F 30 70 00 2F 30 70\n",
    b" (2023-11-14 22:13:20.000100) can0 20000088 [8] 00 00 08 00 00 00 00 00 ERRORFRAME\n\tprotocol-violation{}\n",
    b";$FILEVERSION=2.1\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n 1 10.0 DT 1 0210 Rx - 2 00 FC\n 2 12.0 RR 1 0210 Rx - 8\n",
    b";$FILEVERSION=1.1\n  1) 10.0  Rx  0210  2  00 FC\n  2) 15.0  Warng  FFFFFFFF  4  00 00 00 08  BUSHEAVY\n",
    "(1.000000) can0 210#00\n".encode("utf-16"),
)
ASC = (
    b"date Mon Jun 1 12:00:00.000 am 2026\nbase hex  timestamps absolute\n"
    b" 0.100 1  210 Rx d 8 00 11 22 33 44 55 66 77\n"
)


def blf_seed() -> bytes:
    import can

    path = in_file("seed.blf")
    with can.BLFWriter(path) as writer:
        for k in range(20):
            writer.on_message_received(can.Message(timestamp=1.0 + k, arbitration_id=0x210, data=bytes(8)))
    return path.read_bytes()


def decoded(path: Path) -> Hashable:
    """A trace through the decoder with every shipped database."""
    decoder = Decoder(["machine", "gnss"])
    for entry in decoder.run(read_trace(path)):
        assert entry.text() is not None and entry.as_dict()
    told = decoder.summary()
    names = "frames broken refused lost_fast_packets transported lost_transported unopened_transported"
    return tuple(min(told[name], 2) for name in names.split())


def bus_seeds() -> list[bytes]:
    """A DM1 by the transport protocol of J1939 and a fast packet of NMEA 2000, on two buses."""
    lines = [
        "1CECFF00#200A0002FFCAFE00",
        "1CEBFF00#0104FF6E00040507",
        "1CEBFF00#0208090AFFFFFFFF",
        "0DF8051C#E02B0000FF4CC0EB",
        "0DF8051C#E1FF000000000000",
        "09F8011C#0000000000000000",
    ]
    log = "".join(f"({i}.0{i}) can{bus} {line}\n" for bus in (0, 1) for i, line in enumerate(lines))
    return [log.encode(), *reports(".log")]


def counted(records: Iterable[Any]) -> Hashable:
    """How many frames of a trace are good, how many malformed; three stand for more."""
    good = bad = 0
    for record in records:
        if isinstance(record, MalformedRecord):
            bad += 1
            assert isinstance(record.text, str)
        else:
            good += 1
            assert 0 <= len(record.data) <= 64
    return min(good, 3), min(bad, 3)


def dbc_seeds() -> list[bytes]:
    """The head, three messages and their attributes: a whole file would take cantools a second each time."""
    text = (ROOT / "can_dbc" / "crane.dbc").read_text(encoding="cp1252")
    names = ("ValveCmdA", "EstopStat", "EncSlew")
    numbers = [re.search(rf"^BO_ (\d+) {name}:", text, re.MULTILINE)[1] for name in names]  # type: ignore[index]
    head = text[: text.index("BO_ ")]
    blocks = re.findall(r"^BO_ \d+ \w+:.*\n(?: SG_ .*\n)*", text, re.MULTILINE)
    kept = [block for block in blocks if block.split()[1] in numbers]
    rest = [line for line in text.splitlines() if line.startswith("BA_DEF")]
    rest += [line for line in text.splitlines() if re.match(rf"(BA_|VAL_) .*\b({'|'.join(numbers)})\b", line)]
    return [(head + "\n".join(kept) + "\n" + "\n".join(rest) + "\n").encode("cp1252")]


def used(database: Database) -> Hashable:
    """What the codecs' reader accepts can be used."""
    for codec in list(database.messages.values())[:5]:
        for payload in (bytes(codec.length), b"\xff" * codec.length, b""):
            with contextlib.suppress(FrameRefused):
                codec.receive(payload)
        with contextlib.suppress(InputRefused):
            codec.encode(*(0 for _ in codec.signals))
    return "good"


def guard_dbc(path: Path) -> Hashable:
    """The guard's own reader."""

    def use(name: str) -> None:
        for field in read_layouts(path, [name])[name].fields.values():
            field.inside(field.raw((1 << 64) - 1))

    return tuple(outcome(GuardConfigError, use, name) for name in ("ValveCmdA", "EstopStat", "EncSlew"))


def kcd_seeds() -> list[bytes]:
    """The databases of the DBC seeds as KCD."""
    import cantools

    texts = (seed.decode("cp1252") for seed in dbc_seeds())
    return [cantools.database.load_string(text, "dbc").as_kcd_string().encode() for text in texts]


_RESUMED = ForwardingMission("fuzz", (Point(63.0, 19.0), Point(63.0, 19.001)), logs=(KnownLog(Point(63.0, 19.0)),))


def urdf_seeds() -> list[bytes]:
    """The plant's crane."""
    return [crane_urdf(load_profile("palms_471"), load_truth("nominal", 0, "palms_471")).encode()]


def urdf_answers(path: Path) -> dict[str, Any]:
    """The crane of a URDF, every joint with the name that we give it."""
    return answers_from_urdf(path, {})


def all_finite(answers: dict[str, Any]) -> Hashable:
    """What a machine is made of are numbers."""
    ranges = [bound for joint in answers["joints"].values() for bound in joint.values()]
    assert all(map(math.isfinite, (*answers["kinematics"].values(), *ranges)))
    return len(ranges), len(answers["kinematics"])


def checkpoint_seeds() -> list[bytes]:
    """The progress of one mission: at its start, and with logs aboard, given up and missed."""
    digest_, log = mission_digest(_RESUMED), LoadedLog(Point(63.0, 19.0), 5, 0.1)
    path, seeds = in_file("seed.json"), []
    for tally in (Tally(), Tally(board=[log], loads=[Load((log,), 7, 5.0)], given_up={3: "too far"})):
        CheckpointFile(path).write(Checkpoint(mission=digest_, tally=tally), 5, 10**18)
        seeds.append(path.read_bytes())
    return seeds


def resumed(progress: Checkpoint | None) -> Hashable:
    """What a mission resumes with can be used."""
    assert progress is not None and progress.rotator.turned(1.0).turned(-1.0).corrected(0.5, 0.2).sigma_rad >= 0.0
    return min(progress.tally.loaded, 2), bool(progress.tally.board)


def profile_seeds() -> list[bytes]:
    return [path.read_bytes() for path in sorted((ROOT / "machine").glob("*.toml")) if "envelope" not in path.name]


def has_carrier(settings: Settings) -> Hashable:
    return settings.profile.carrier is not None


def guards(guard: Guard) -> Hashable:
    """A guard that was made from files judges."""
    traffic = Traffic()
    traffic.guard = guard
    traffic.tick(3)
    traffic.a.update(MOVING)
    traffic.tick(2)
    return guard.verdict


def sealed(data: bytes) -> bytes:
    """An envelope file with the digest that fits, after other values."""
    body = other_values(envelope_seeds, _TOML_VALUE, _TOML)(data).rpartition(SEAL)[0]
    return body + SEAL + digest(body) + b"\n"


def envelope_seeds() -> list[bytes]:
    return [(ROOT / "machine" / "palms_471.envelope.toml").read_bytes()]


def start_envelope() -> Run:
    """The guard's envelope beside a good profile."""
    path = in_file("palms_471.envelope.toml")
    shutil.copy(ROOT / "machine" / "palms_471.toml", path.with_name("fuzz.toml"))

    def run(data: bytes) -> Hashable:
        path.write_bytes(data)
        return outcome(GuardConfigError, build, path.with_name("fuzz.toml"), then=guards)

    return run


def weight_seeds() -> list[bytes]:
    """The smallest network shipped, whole and cut."""
    whole = (networks.SHIPPED / f"{QUALITY_NETWORK.name}.onnx").read_bytes()
    return [whole, whole[:200]]


def load_weights(path: Path) -> dict[str, Any]:
    """Of the network that scores segments; what the fuzzer changed is sealed again, so that the parser sees it."""
    data = path.read_bytes()
    if len(data) > networks.DIGEST_BYTES:
        body = data[: -networks.DIGEST_BYTES]
        path.write_bytes(body + networks.digest(body))
    return networks.load(path, QUALITY_NETWORK).arrays()


def finite(arrays: dict[str, Any]) -> Hashable:
    assert all(np.isfinite(a).all() for a in arrays.values())
    return "good"


_JSON = (b"null", b"[]", b"{}", b'"', b"NaN", b"1e309", b"-1", b"true", b'"role":"log",', b'"coordinates":', b"\\ud800")
_XML = (b"<!DOCTYPE x>", b"&lol;", b"&#0;", b"<![CDATA[", b"</rte>", b"<trk>", b'lat="nan"', b'xmlns="urn:x"', b"Stem")
_NUMBERS = b"nan -1 0 1e400 99999999999999999999"
_TOML = (
    *_NUMBERS.split(),
    *b'inf 5e-324 99999999999 true 1979-05-27 {} [] "" "\\u0000" [ ] [[ = [joints.slew]'.split(),
    *(b"[1, 2]", b"{a = 1}"),
)
_DBC = (*_NUMBERS.split(), *b'64 7x @1+ @0- | m0 M " ; (0,0) [0|0]'.split(), b"BO_ ", b" SG_ ", b"BA_ ", b"VAL_ ")
_XML_VALUE = rb'="([^"]*)"'
_XML_NUMBERS = (*_XML, *_NUMBERS.split())
_DBC_VALUE = rb"(-?[0-9.]+|[+-] )"
_TOML_VALUE = rb"= *([^\n#]+)"


def _files(
    name: str,
    start: Callable[[], Run],
    seeds: Callable[[], Sequence[bytes]],
    words: tuple[bytes, ...] = (),
    value: bytes = b"",
    max_bytes: int = 1 << 16,
) -> Target:
    mend = other_values(seeds, value, words) if value else None
    return Target(name, "files", start, seeds, words, mend, max_bytes=max_bytes)


_PROFILE = of_file("fuzz.toml", ConfigError, load_settings, has_carrier)
_CHECKPOINT = of_file(
    "fuzz.json", (MissionError, InputRefused), lambda path: read_checkpoint(path, _RESUMED, 7, 10**18), resumed
)
_GUARD_PROFILE = of_file("fuzz.toml", GuardConfigError, build, guards)
FILES = (
    _files("mission-file", lambda: mission, mission_seeds, _JSON + _XML, rb"[:,>\"] *([-0-9.]+|\"[^\"]*\")"),
    _files("recording", of_file("run.mcap", InputRefused, read_recording, repaired), recording_seeds),
    _files("trace-text", of_file("trace.log", (), read_trace, counted), lambda: [*TRACES, *reports(".trc")]),
    _files("trace-asc", of_file("trace.asc", (), read_trace, counted), lambda: [ASC, *reports(".asc")], max_bytes=4096),
    _files("trace-blf", of_file("trace.blf", (), read_trace, counted), lambda: [blf_seed(), *reports(".blf")]),
    _files("trace-decoded", of_file("trace.log", (), decoded, tuple), bus_seeds),
    _files("dbc", of_file("fuzz.dbc", ConfigError, load_dbc, used), dbc_seeds, _DBC, _DBC_VALUE, 1 << 14),
    _files("kcd", of_file("fuzz.kcd", ConfigError, load_dbc, used), kcd_seeds, _XML_NUMBERS, _XML_VALUE, 1 << 14),
    _files("urdf", of_file("fuzz.urdf", InputRefused, urdf_answers, all_finite), urdf_seeds, _XML_NUMBERS, _XML_VALUE),
    _files("checkpoint", _CHECKPOINT, checkpoint_seeds, _JSON, rb"[:,\[] *([-0-9.e+]+|\"[^\"]*\")"),
    _files("profile", _PROFILE, profile_seeds, _TOML, _TOML_VALUE),
    _files("guard-dbc", of_file("guard.dbc", (), guard_dbc, tuple), dbc_seeds, _DBC, _DBC_VALUE, 1 << 14),
    _files("guard-profile", _GUARD_PROFILE, profile_seeds, _TOML, _TOML_VALUE),
    Target("guard-envelope", "files", start_envelope, envelope_seeds, _TOML, sealed),
    _files("weights", of_file("fuzz.onnx", InputRefused, load_weights, finite), weight_seeds, _JSON),
)
