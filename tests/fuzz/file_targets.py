"""Files: missions, recordings, traces, databases, profiles, the guard's own readers, and network weights."""

from __future__ import annotations

import contextlib
import random
import re
import shutil
import tempfile
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path

import numpy as np

from autonomy.missions.mission_file import read as read_mission
from autonomy.missions.mission_file import verify
from autonomy.missions.model import MissionError
from autonomy.networks import weights
from autonomy.networks.graph import Network, parameter_shapes
from autonomy.networks.weights import WeightsError
from can_dbc.dbc.codec import DbcError, EncodeRefused, FrameRefused
from can_dbc.dbc.codec import load as load_dbc
from can_dbc.trace.candump import MalformedRecord, read_trace
from controller.config import ConfigError
from controller.config import load as load_settings
from controller.guard.__main__ import build
from controller.guard.envelope import SEAL, digest
from controller.guard.layout import GuardConfigError, read_layouts
from recorder.mcap_scan import NotMcap, is_complete, scan
from recorder.recover import recover
from tests.controller.guard_traffic import MOVING, Traffic
from tests.fuzz.engine import Run, Target
from tests.fuzz.message_targets import in_file
from tests.fuzz.sentences import coded_sentence
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
            texts.extend((text, list(re.finditer(value, text, re.MULTILINE))) for text in seeds())
        rng = random.Random(data)
        if rng.random() < 0.2:
            return data
        text, found = rng.choice(texts)
        for match in sorted(rng.sample(found, rng.choice((1, 1, 1, 2, 3))), key=lambda m: -m.start()):
            text = text[: match.start(1)] + rng.choice(words) + text[match.end(1) :]
        return text

    return changed


def mission_seeds() -> list[bytes]:
    return [path.read_bytes() for path in sorted(EXAMPLES.iterdir()) if path.stat().st_size < 40_000]


def start_mission() -> Run:
    def run(data: bytes) -> tuple[int, Hashable]:
        try:
            draft = read_mission(data, "file")
            verify(draft, site=(63.657853, 19.895562))
        except MissionError as refused:
            coded_sentence(refused)
            assert all(p.place.startswith("file") and p.code and "\n" not in p.sentence for p in refused.problems)
            return 1, tuple(p.code for p in refused.problems)[:3]
        return 1, draft.format

    return run


def recording_seeds() -> list[bytes]:
    folder = Path(tempfile.mkdtemp(prefix="timberhand-fuzz-"))
    try:
        recorder = recordings.record(folder, 24)
        with contextlib.suppress(Exception):
            recorder.close()
        whole = (folder / "run.mcap").read_bytes()
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return [whole, whole[: len(whole) * 2 // 3]]


def start_recording() -> Run:
    """A damaged recording is read up to its damage, and repaired to something that can be read whole."""
    folder = in_file("run")
    folder.mkdir()
    path = folder / "run.mcap"

    def run(data: bytes) -> tuple[int, Hashable]:
        path.write_bytes(data)
        try:
            before = sum(1 for _ in scan(path))
        except NotMcap as refused:
            coded_sentence(refused)
            with contextlib.suppress(NotMcap):
                recover(folder)
            return 1, refused.code
        complete = is_complete(path)
        repaired = recover(folder)
        assert bool(repaired) is not complete
        if repaired:
            assert is_complete(path) and sum(1 for _ in scan(path)) >= repaired[0].messages
        return 1, (before > 0, complete, bool(repaired))

    return run


TRACES = (
    b"(1700000000.123456) can0 210#0011223344556677\n(1700000000.2) can0 18FF2F27#R\n",
    b"  can0  210   [8]  00 11 22 33 44 55 66 77\n (0.000100)  can0  TX - -  210  [2]  AA BB   '..'\n",
    b"   1)      1059.9  Rx         0210  8  00 11 22 33 44 55 66 77\n",
    b"17:33:21.107 R 19F51323 01 2F 30 70 00 2F 30 70\n",
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


def trace(suffix: str) -> Callable[[], Run]:
    """The reader of one kind of trace."""

    def start() -> Run:
        path = in_file(f"trace{suffix}")

        def run(data: bytes) -> tuple[int, Hashable]:
            path.write_bytes(data)
            good = bad = 0
            for record in read_trace(path):
                if isinstance(record, MalformedRecord):
                    bad += 1
                    assert isinstance(record.text, str)
                else:
                    good += 1
                    assert 0 <= len(record.data) <= 64
            return 1, (min(good, 3), min(bad, 3))

        return run

    return start


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


def start_dbc() -> Run:
    """The codecs' reader; what it accepts can be used."""
    path = in_file("fuzz.dbc")

    def run(data: bytes) -> tuple[int, Hashable]:
        path.write_bytes(data)
        found: list[Hashable] = []
        try:
            database = load_dbc(path)
        except DbcError as refused:
            coded_sentence(refused)
            found.append(refused.code)
        else:
            found.append("good")
            for codec in list(database.messages.values())[:5]:
                for payload in (bytes(codec.length), b"\xff" * codec.length, b""):
                    with contextlib.suppress(FrameRefused):
                        codec.receive(payload)
                with contextlib.suppress(EncodeRefused):
                    codec.encode(*(0 for _ in codec.signals))
        return 1, tuple(found)

    return run


def start_guard_dbc() -> Run:
    """The guard's own reader."""
    path = in_file("guard.dbc")

    def run(data: bytes) -> tuple[int, Hashable]:
        path.write_bytes(data)
        found: list[Hashable] = []
        for name in ("ValveCmdA", "EstopStat", "EncSlew"):
            try:
                layout = read_layouts(path, [name])[name]
                for field in layout.fields.values():
                    field.inside(field.raw((1 << 64) - 1))
                found.append("good")
            except GuardConfigError as refused:
                coded_sentence(refused)
                found.append(refused.code)
        return 1, tuple(found)

    return run


def profile_seeds() -> list[bytes]:
    return [path.read_bytes() for path in sorted((ROOT / "machine").glob("*.toml")) if "envelope" not in path.name]


def start_profile() -> Run:
    """The controller's profile."""
    path = in_file("fuzz.toml")

    def run(data: bytes) -> tuple[int, Hashable]:
        path.write_bytes(data)
        try:
            settings = load_settings(path)
        except ConfigError as refused:
            coded_sentence(refused)
            return 1, refused.code
        return 1, settings.profile.carrier is not None

    return run


def guard_limits(*suffixes: str) -> Callable[[], Run]:
    """The files of limits that the guard reads; the input replaces the one with the last suffix."""

    def start() -> Run:
        folder = in_file("guard")
        folder.mkdir()
        for suffix in suffixes:
            shutil.copy(ROOT / "machine" / f"palms_471{suffix}", folder / f"fuzz{suffix}")

        def run(data: bytes) -> tuple[int, Hashable]:
            (folder / f"fuzz{suffixes[-1]}").write_bytes(data)
            try:
                traffic = Traffic()
                traffic.guard = build(folder / "fuzz.toml")
            except GuardConfigError as refused:
                coded_sentence(refused)
                return 1, refused.code
            traffic.tick(3)
            traffic.a.update(MOVING)
            traffic.tick(2)
            return 1, "good"

        return run

    return start


def sealed(data: bytes) -> bytes:
    """An envelope file with the digest that fits, after other values."""
    body = other_values(envelope_seeds, _TOML_VALUE, _TOML)(data).rpartition(SEAL)[0]
    return body + SEAL + digest(body) + b"\n"


def envelope_seeds() -> list[bytes]:
    return [(ROOT / "machine" / "palms_471.envelope.toml").read_bytes()]


def start_envelope() -> Run:
    """The guard's envelope beside a good profile: whatever passes makes a guard that judges."""
    folder = in_file("guard")
    folder.mkdir()
    shutil.copy(ROOT / "machine" / "palms_471.toml", folder / "fuzz.toml")

    def run(data: bytes) -> tuple[int, Hashable]:
        (folder / "palms_471.envelope.toml").write_bytes(data)
        try:
            guard = build(folder / "fuzz.toml")
        except GuardConfigError as refused:
            coded_sentence(refused)
            return 1, refused.code
        traffic = Traffic()
        traffic.guard = guard
        traffic.tick(3)
        traffic.a.update(MOVING)
        traffic.tick(2)
        return 1, traffic.guard.verdict

    return run


def small_network() -> Network:
    """The network that scores segments, the smallest one shipped."""
    from autonomy.perception.segmentation.segment_merging import QUALITY_NETWORK

    return QUALITY_NETWORK


def weight_seeds() -> list[bytes]:
    network, path = small_network(), in_file("seed.safetensors")
    arrays = {name: np.zeros(shape, np.float32) for name, shape in parameter_shapes(network).items()}
    weights.save(path, network, arrays, {"data": "fuzz"})
    return [path.read_bytes(), path.read_bytes()[:200]]


def start_weights() -> Run:
    network, path = small_network(), in_file("fuzz.safetensors")

    def run(data: bytes) -> tuple[int, Hashable]:
        path.write_bytes(data)
        try:
            arrays, _ = weights.load(path, network)
        except WeightsError as refused:
            coded_sentence(refused)
            return 1, refused.code
        assert all(np.isfinite(a).all() for a in arrays.values())
        return 1, "good"

    return run


_JSON = (b"null", b"[]", b"{}", b'"', b"NaN", b"1e309", b"-1", b"true", b'"role":"log",', b'"coordinates":', b"\\ud800")
_XML = (b"<!DOCTYPE x>", b"&lol;", b"&#0;", b"<![CDATA[", b"</rte>", b"<trk>", b'lat="nan"', b'xmlns="urn:x"', b"Stem")
_TOML = (
    b"{}",
    b"[]",
    b"[1, 2]",
    b"1979-05-27",
    b"5e-324",
    b'"\\u0000"',
    b"{a = 1}",
    b"[",
    b"]",
    b"=",
    b"[joints.slew]",
    b"nan",
    b"inf",
    b"-1",
    b"0",
    b'""',
    b"[[",
    b"1e400",
    b"true",
    b"99999999999",
)
_DBC = (
    b"-1",
    b"0",
    b"99999999999999999999",
    b"1e400",
    b"nan",
    b"7x",
    b"BO_ ",
    b" SG_ ",
    b"@1+",
    b"@0-",
    b"|",
    b"m0",
    b"M",
    b"BA_ ",
    b"VAL_ ",
    b'"',
    b";",
    b"(0,0)",
    b"[0|0]",
    b"64",
)

_DBC_VALUE = rb"(-?[0-9.]+|[+-] )"
_TOML_VALUE = rb"= *([^\n#]+)"


def _files(
    name: str,
    start: Callable[[], Run],
    seeds: Callable[[], Sequence[bytes]],
    words: tuple[bytes, ...] = (),
    max_bytes: int = 1 << 16,
    value: bytes = b"",
) -> Target:
    mend = other_values(seeds, value, words) if value else None
    return Target(name, "files", start, seeds, words, mend, max_bytes=max_bytes)


FILES = (
    _files("mission-file", start_mission, mission_seeds, _JSON + _XML, value=rb"[:,>\"] *([-0-9.]+|\"[^\"]*\")"),
    _files("recording", start_recording, recording_seeds),
    _files("trace-text", trace(".log"), lambda: list(TRACES)),
    _files("trace-asc", trace(".asc"), lambda: [ASC], max_bytes=4096),
    _files("trace-blf", trace(".blf"), lambda: [blf_seed()]),
    _files("dbc", start_dbc, dbc_seeds, _DBC, 1 << 14, _DBC_VALUE),
    _files("profile", start_profile, profile_seeds, _TOML, value=_TOML_VALUE),
    _files("guard-dbc", start_guard_dbc, dbc_seeds, _DBC, 1 << 14, _DBC_VALUE),
    _files("guard-profile", guard_limits(".toml"), profile_seeds, _TOML, value=_TOML_VALUE),
    Target("guard-envelope", "files", start_envelope, envelope_seeds, _TOML, sealed),
    _files("weights", start_weights, weight_seeds, _JSON),
)
