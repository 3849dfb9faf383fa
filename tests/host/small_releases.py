"""Small signed bundles, and services and programs that only note what they are told."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path
from unittest import mock

from host.release import bundle as bundles
from host.release.gate import Gate, ServiceReading
from host.release.services import Services
from host.release.signature import make_keys
from host.release.trees import CURRENT, MARKER, Trees
from host.release.updater import Program, Updater

DECISIVE = (
    "machine/palms.toml",
    "machine/palms.envelope.toml",
    "machine/__init__.py",
    "can_dbc/crane.dbc",
    "can_dbc/encoder.eds",
    "autonomy/weights/logs.onnx",
)
"""The files of a small wheel: one of every kind that decides how a machine behaves, and a module."""
METADATA = "Metadata-Version: 2.1\nName: timberhand\nVersion: {}\n"
GOOD = (
    ServiceReading(True, "STANDBY. Ready. Missed ticks: 0 of 9.", 7),
    ServiceReading(True, "Valves enabled: GOOD. The bus is ACTIVE.", 8),
)
DEAD = ServiceReading(False, "", 0)


def small_wheel(folder: Path, version: str, deploy: Path | None = None) -> Path:
    """A wheel with the decisive files and the folder ``deploy``."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"timberhand-{version}-py3-none-any.whl"
    info = f"timberhand-{version}.dist-info"
    with zipfile.ZipFile(path, "w") as archive:
        for name in DECISIVE:
            archive.writestr(name, "" if name.endswith(".py") else f"{name} of {version}\n")
        for file in deploy.rglob("*") if deploy is not None else ():
            if file.is_file() and "__pycache__" not in file.parts:
                archive.write(file, Path("deploy", file.relative_to(deploy)))
        archive.writestr(f"{info}/METADATA", METADATA.format(version))
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{info}/RECORD", "")
    return path


def small_bundle(folder: Path, version: str, private: Path, deploy: Path | None = None) -> Path:
    """A signed bundle of a small wheel, with an empty list of parts: the real one takes seconds."""
    with mock.patch.object(bundles, "_add_sbom", lambda place: (place / bundles.SBOM).write_text("{}\n")):
        return bundles.make(small_wheel(folder / "wheel", version, deploy), private, folder, None, None)


def keys(folder: Path) -> tuple[Path, Path]:
    """A pair of keys: (private, public)."""
    return make_keys(folder / "keys")


class NotedServices(Services):
    """Services that are good, unless ``broken`` is part of the name of the release in use."""

    def __init__(self, trees: Trees, broken: str = "no release", note: Callable[[str], None] = lambda _: None) -> None:
        self._trees, self._broken, self._note = trees, broken, note
        self.told: list[str] = []
        self.armed: str | None = "STANDBY"
        self.running: str | None = None

    def mode(self) -> str | None:
        return self.armed

    def stop(self) -> None:
        self._tell("stop")
        self.running = None

    def reload(self) -> None:
        self._tell("reload")

    def start(self) -> None:
        self._tell("start")
        self.running = self._trees.state().current

    def start_others(self) -> None:
        self._tell("start others")

    def readings(self) -> tuple[ServiceReading, ServiceReading]:
        self._tell("judged")
        good = self.running is not None and self._broken not in self.running
        return GOOD if good else (DEAD, DEAD)

    def _tell(self, word: str) -> None:
        self._note(word)
        self.told.append(word)


class NotedProgram(Program):
    """A release's program whose build unpacks its wheel; ``note`` is called in the middle of it."""

    def __init__(self, note: Callable[[str], None] = lambda _: None) -> None:
        self._note = note
        self.told: list[str] = []

    def build(self, incoming: Path, tree: Path) -> None:
        self._note("build")
        tree.mkdir()
        with zipfile.ZipFile(next((incoming / "wheels").iterdir())) as archive:
            archive.extractall(tree / "site")

    def check(self, tree: Path) -> None:
        self.told.append("check")
        assert tree.is_dir()

    def links(self, tree: Path) -> None:
        self._note("links")
        self.told.append("links")


def install(trees: Trees, bundle: Path, signer: Path) -> None:
    """The first installation, as install.sh does it."""
    bundles.unpack(bundle, trees.incoming)
    name = bundles.check(trees.incoming, signer).name
    trees.releases.mkdir(parents=True)
    NotedProgram().build(trees.incoming, trees.tree(name))
    trees.seal(name, (trees.incoming / MARKER).read_bytes())
    trees.point(CURRENT, name)
    trees.clear()


def at_once(begin_ns: int) -> Gate:
    """A gate that decides at the first reading."""
    return Gate(begin_ns, hold_ns=0, limit_ns=0)


def updater(
    trees: Trees,
    signer: Path,
    services: NotedServices,
    program: NotedProgram | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> Updater:
    """An updater with these hands."""
    return Updater(trees, signer, services, program or NotedProgram(), report, at_once)
