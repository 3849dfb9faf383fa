"""Missions in zip and gzip files: read with their names, bounded in size, and refused with the true reason."""

from __future__ import annotations

import gzip
import io
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import pytest

from autonomy.missions import source
from autonomy.missions.mission_file import load_mission, read
from tests.autonomy.mission_checks import EXAMPLES, assert_route, codes, good, place
from tests.autonomy.mission_texts import ROUTE, collection, gpx, gpx_points, kml, kml_coordinates, line

HPR = (EXAMPLES / "harvest.hpr").read_bytes()
KML = kml(f"<Placemark><LineString><coordinates>{kml_coordinates(ROUTE)}</coordinates></LineString></Placemark>")
GPX = gpx(f"<rte>{gpx_points('rtept')}</rte>")
BOMB = 1 << 27


def zipped(files: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return made.getvalue()


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED])
def test_a_zip_file_with_one_mission(method: int) -> None:
    plain, packed = read(HPR, "m"), read(zipped({"harvest.hpr": HPR}, method), "m")
    assert packed.mission == plain.mission and packed.notes == plain.notes and packed.format == plain.format


def test_a_kmz_with_pictures_and_linked_files() -> None:
    files = {
        "files/": b"",
        "files/icon.png": b"\x89PNG",
        "files/more.kml": KML,
        "doc.kml": KML,
        "__MACOSX/._doc.kml": b"x",
    }
    draft = good(zipped(files))
    assert_route(draft.mission)
    assert len(draft.notes) == 1 and draft.notes[0].startswith("2 ")


@pytest.mark.parametrize("data", [collection(line()), GPX, KML, collection(line()).decode().encode("utf-16")])
def test_gzip(data: bytes) -> None:
    assert_route(good(gzip.compress(data)).mission)
    half = len(data) // 2
    assert_route(good(gzip.compress(data[:half]) + gzip.compress(data[half:]) + bytes(512)).mission)


def test_the_place_of_a_problem_names_the_file_inside() -> None:
    wrong = GPX.replace(b'lat="', b'lat="x', 1)
    assert codes(zipped({"a\nb.gpx": wrong})) == ["number"] and place(zipped({"a\nb.gpx": wrong})) == "m/a b.gpx:3"
    assert place(gzip.compress(wrong)) == "m:3"


@pytest.mark.parametrize(
    "data",
    [
        zipped({}),
        zipped({"readme.txt": b"x"}),
        zipped({"a.hpr": HPR, "b.hpr": HPR}),
        zipped({"a.hpr": HPR}, zipfile.ZIP_LZMA),
        zipped({"a.kml": zipped({"doc.kml": KML})}, zipfile.ZIP_STORED),
        zipped({"a.kml": gzip.compress(KML)}),
        zipped({"a.hpr": HPR}).replace(b"\x14\x00\x00\x00\x08\x00", b"\x14\x00\x01\x00\x08\x00"),
        zipped({f"{i}.txt": b"" for i in range(source.MAX_PACKED + 1)} | {"doc.kml": KML}, zipfile.ZIP_STORED),
        gzip.compress(HPR) + b"rest",
        gzip.compress(gzip.compress(HPR)),
        b"".join(gzip.compress(bytes((c,))) for c in GPX),
    ],
)
def test_whole_archives_that_are_refused(data: bytes) -> None:
    assert codes(data) == ["archive"]


@pytest.mark.parametrize(
    "data",
    [
        b"PK",
        zipped({"a.hpr": HPR})[:-30],
        zipped({"a.hpr": HPR}, zipfile.ZIP_STORED).replace(b"Latitude", b"Latitudo", 1),
        gzip.compress(HPR)[:-9],
        gzip.compress(HPR)[:-1] + b"\1",
        b"\x1f\x8b",
    ],
)
def test_damaged_archives_are_said_to_be_damaged(data: bytes) -> None:
    assert codes(data) == ["archive-damaged"]


@pytest.mark.parametrize("kind", ["zip", "gzip", "lie"])
def test_a_bomb_costs_no_more_than_the_largest_mission(kind: str) -> None:
    if kind == "gzip":
        packer = zlib.compressobj(9, wbits=31)
        data = b"".join(packer.compress(bytes(1 << 20)) for _ in range(BOMB >> 20)) + packer.flush()
    else:
        data = zipped({"doc.kml": bytes(BOMB)})
    if kind == "lie":  # of its size, in the entry and in the directory
        for at in (22, data.rindex(b"PK\x01\x02") + 24):
            assert data[at : at + 4] == BOMB.to_bytes(4, "little")
            data = data[:at] + (1000).to_bytes(4, "little") + data[at + 4 :]
    tracemalloc.start()
    try:
        assert codes(data) == (["archive-damaged"] if kind == "lie" else ["too-large"])
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 2.5 * source.MAX_XML_BYTES


def test_a_packed_file_by_its_path(tmp_path: Path) -> None:
    path = tmp_path / "harvest.hprz"
    path.write_bytes(zipped({"harvest.hpr": HPR}))
    assert load_mission(path).mission == read(HPR, "m").mission
