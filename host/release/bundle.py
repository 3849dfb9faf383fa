"""A bundle: everything of a release in one tar file, for a computer without a network.

::

    SHA256SUMS, SHA256SUMS.sig   every other file, and the signature (`host.release.signature`)
    install.sh                   installs the bundle (deploy/bundle_install.sh)
    release.json                 `Release`
    requirements.txt             exact versions with hashes, for ``pip install --require-hashes``
    wheels/*.whl                 the program, and all packages that it needs
    program.sha256               every file of the program as it lies in site-packages: code, profiles, envelopes, DBC,
                                 EDS, weights (`host.release.installed`)
    sbom.cdx.json                what is in it, as CycloneDX

The same wheels give the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path, PurePosixPath
from typing import Final

from packaging.utils import parse_wheel_filename

from host.exit_codes import CommandFailed
from host.release import sums
from host.release.signature import sign, signature_path, verify
from host.release.trees import MARKER

SUMS: Final = "SHA256SUMS"
PROGRAM_SUMS: Final = "program.sha256"
REQUIREMENTS: Final = "requirements.txt"
SBOM: Final = "sbom.cdx.json"
_DEPLOY: Final = Path(__file__).parents[2] / "deploy"
_ARM64: Final = "aarch64"
_ARM64_PLATFORMS: Final = ("manylinux2014_aarch64", *(f"manylinux_2_{minor}_aarch64" for minor in range(17, 37)))
"""What runs on Debian 12, whose C library is 2.36.  pip takes each name as it is: 2.35 does not include 2.28."""
_NAME: Final = re.compile(r"[0-9][0-9A-Za-z.+]*-[0-9a-f]{12}")
_DOWNLOAD_S: Final = 900.0


class Lock(StrEnum):
    """Which packages a bundle brings: a file of deploy/lock in the wheel, with their versions and hashes."""

    MACHINE = "machine"
    """What a machine's computer needs; install.sh takes the same from the network."""
    PLANT = "plant"
    """The same with the physics plant, for the demo and for tests without a machine."""


@dataclass(frozen=True, slots=True)
class Release:
    """What a bundle says of itself: its name, ``VERSION-HASH`` of the program's wheel; the wheel; and the processor
    that its packages are for (``uname -m``)."""

    name: str
    version: str
    wheel: str
    machine: str


def make(wheel: Path, private: Path, out: Path, find_links: Path | None, lock: Lock | None) -> Path:
    """Make and sign a bundle of a wheel; returns the tar file.

    The packages are those that the wheel's own ``lock`` names, from the package index or from ``find_links`` alone;
    None leaves them out, for computers that take them from an environment.

    Raises:
        CommandFailed: the wheel or the key is unusable, packages are missing, or ``out`` cannot be written.
    """
    release = _release_of(wheel)
    folder = out / f"timberhand-{release.name}"
    shutil.rmtree(folder, ignore_errors=True)
    try:
        (folder / "wheels").mkdir(parents=True)
        shutil.copy(wheel, folder / "wheels")
        if lock is not None:
            _add_packages(folder / "wheels", release, find_links, lock)
        (folder / REQUIREMENTS).write_text(requirements(sorted((folder / "wheels").iterdir())))
        shutil.copyfile(_DEPLOY / "bundle_install.sh", folder / "install.sh")
        (folder / PROGRAM_SUMS).write_text(sums.encode(program_sums(wheel)))
        (folder / MARKER).write_text(json.dumps(asdict(release), indent=2) + "\n")
        _add_sbom(folder)
        (folder / SUMS).write_text(sums.encode(sums.of_files(folder, _files(folder) - {SUMS})))
        sign(folder / SUMS, private)
        archive = out / f"{folder.name}.tar"
        _pack(folder, archive)
    except zipfile.BadZipFile as error:
        raise CommandFailed("bundle.no-wheel", f"{wheel} is damaged: {error}; make it again: make wheel") from None
    except OSError as error:
        sentence = f"the bundle cannot be made in {out}: {error.strerror}; make room there, or name another --out"
        raise CommandFailed("bundle.not-written", sentence) from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return archive


def requirements(wheels: Sequence[Path]) -> str:
    """Write requirements with hashes of exactly these wheels."""
    lines = []
    for wheel in wheels:
        name, version, _, _ = parse_wheel_filename(wheel.name)
        lines.append(f"{name}=={version} --hash=sha256:{sums.sha256_of(wheel)}\n")
    return "".join(sorted(lines))


def program_sums(wheel: Path) -> dict[str, str]:
    """Map each name below site-packages to the hash of a file that a wheel installs there, but for pip's own record."""
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if not name.endswith(("/", "/RECORD"))]
        if moved := [name for name in names if ".data/" in name]:
            raise CommandFailed(
                "bundle.data-files", f"{wheel} installs {moved[0]} outside site-packages; build it without"
            )
        return {name: hashlib.sha256(archive.read(name)).hexdigest() for name in names}


def unpack(bundle: Path, folder: Path) -> None:
    """Unpack a bundle, a tar file or a folder, into a new folder.

    Raises:
        CommandFailed: there is no such bundle.
        OSError: the folder cannot be written.
    """
    if not os.access(bundle, os.R_OK):
        raise CommandFailed("bundle.unreadable", f"{bundle} cannot be read; name the file that `make bundle` made")
    if bundle.is_dir():
        shutil.copytree(bundle, folder)
        return
    folder.mkdir(parents=True)
    try:
        with tarfile.open(bundle) as archive:
            for member in archive:
                path = PurePosixPath(member.name)
                parts = path.parts[1:]  # below the bundle's own folder
                if not member.isfile() or not parts or ".." in parts or path.is_absolute():
                    continue  # what is missing then is found by the hashes
                target = folder.joinpath(*parts)
                target.parent.mkdir(parents=True, exist_ok=True)
                source = archive.extractfile(member)
                assert source is not None  # a regular file
                with source, target.open("wb") as file:
                    shutil.copyfileobj(source, file)
    except tarfile.TarError:
        raise CommandFailed(
            "bundle.no-bundle", f"{bundle} is no bundle; name the tar file that `make bundle` made"
        ) from None


def check(folder: Path, public: Path) -> Release:
    """Check signature and files of an unpacked bundle; returns what it is.

    Raises:
        CommandFailed: it is not what somebody with that key signed.
    """
    if not (folder / SUMS).is_file():
        raise CommandFailed(
            "bundle.no-sums", f"the bundle holds no {SUMS}, so it is none; name the file that `make bundle` made"
        )
    verify(folder / SUMS, public)
    listed = sums.decode((folder / SUMS).read_text(), str(folder / SUMS))
    unlisted = _files(folder) - listed.keys() - {SUMS, signature_path(Path(SUMS)).name}
    wrong = sums.differing(folder, listed) or sorted(unlisted)
    if wrong:
        raise CommandFailed("bundle.changed", f"{wrong[0]} in the bundle is not what was signed; get the bundle again")
    release = Release(**json.loads((folder / MARKER).read_text()))
    if not _NAME.fullmatch(release.name):
        raise CommandFailed("bundle.name", f"{release.name!r} is no name of a release")
    return release


def check_for_here(folder: Path, public: Path) -> Release:
    """Check a bundle that is to be installed on this computer, as `check` does; raises CommandFailed."""
    release = check(folder, public)
    if release.machine != platform.machine():
        raise CommandFailed(
            "bundle.other-machine",
            f"the bundle is for {release.machine}, and this computer is {platform.machine()}; get that one",
        )
    return release


def _release_of(wheel: Path) -> Release:
    try:
        name, version, _, tags = parse_wheel_filename(wheel.name)
        if name == "timberhand":
            # A pure wheel runs on every processor, and its packages are those of this one.
            arm64 = any(tag.platform.endswith(f"_{_ARM64}") for tag in tags)
            machine = _ARM64 if arm64 else platform.machine()
            return Release(f"{version}-{sums.sha256_of(wheel)[:12]}", str(version), wheel.name, machine)
    except (ValueError, OSError):
        pass
    raise CommandFailed("bundle.no-wheel", f"{wheel} is no wheel of timberhand; make one: make wheel")


def _add_packages(folder: Path, release: Release, find_links: Path | None, lock: Lock) -> None:
    """Download what the wheel needs beside it: exactly the files whose hashes it was built with."""
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "download", "--quiet", "--dest", str(folder)]
    command += ["--no-deps", "--only-binary=:all:", "--require-hashes", "--requirement", "/dev/stdin"]
    if find_links is not None:
        command += ["--no-index", "--find-links", str(find_links)]
    if release.machine != platform.machine():
        command += [word for name in _ARM64_PLATFORMS for word in ("--platform", name)]
        command += ["--python-version", "3.11", "--implementation", "cp"]
    try:
        done = subprocess.run(
            command,
            input=_locked(folder / release.wheel, lock),
            capture_output=True,
            text=True,
            check=False,
            timeout=_DOWNLOAD_S,
        )
    except subprocess.TimeoutExpired:
        raise CommandFailed(
            "bundle.slow-download", f"the packages did not come within {_DOWNLOAD_S:.0f} s; use --find-links DIR"
        ) from None
    if done.returncode:
        reason = next((line for line in reversed(done.stderr.splitlines()) if line.startswith("ERROR")), "no message")
        raise CommandFailed(
            "bundle.no-packages", f"a package cannot be had: {reason}; name a folder that has it with --find-links"
        )


def _locked(wheel: Path, lock: Lock) -> str:
    name = f"deploy/lock/{lock}.txt"
    try:
        with zipfile.ZipFile(wheel) as archive:
            return archive.read(name).decode()
    except KeyError:
        raise CommandFailed(
            "bundle.no-lock", f"{wheel.name} holds no {name}, so no package can be checked; build it anew: make wheel"
        ) from None


def _add_sbom(folder: Path) -> None:
    """Describe what is in the bundle, as CycloneDX 1.6, from its requirements with their hashes."""
    command = [sys.executable, "-m", "cyclonedx_py", "requirements", "--output-reproducible", "--of", "JSON"]
    done = subprocess.run(
        [*command, "-o", str(folder / SBOM), str(folder / REQUIREMENTS)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise CommandFailed(
            "bundle.no-sbom", f"the list of parts cannot be made: {reason}; pip install 'timberhand[audit]'"
        )


def _files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def _pack(folder: Path, archive: Path) -> None:
    """Write a tar file that depends on the contents alone, whole or not at all."""

    def plain(entry: tarfile.TarInfo) -> tarfile.TarInfo:
        entry.mtime = entry.uid = entry.gid = 0
        entry.uname = entry.gname = "root"
        entry.mode = 0o644
        return entry

    fresh = archive.with_name(f"{archive.name}.new")
    try:
        with tarfile.open(fresh, "w", format=tarfile.PAX_FORMAT) as file:
            for name in sorted(_files(folder)):
                file.add(folder / name, f"{folder.name}/{name}", filter=plain)
        os.replace(fresh, archive)
    finally:
        fresh.unlink(missing_ok=True)
