"""A stranger's Debian reaches a running crane by what docs/how-to/service.md says, and by nothing else.

The lines are taken from the page.  The root holds no part of this computer, and no network but the loopback, so
whatever the page forgets, and whatever the bundle lacks, is missing here.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import pytest

from host.exit_codes import CommandFailed, ExitCode
from host.release import bundle as bundles
from host.release import sums
from host.release.signature import make_keys
from host.service_lab.host import build_wheel
from tests.live.deploy import debian_root
from tests.live.deploy.debian_root import DebianRoot

pytestmark = [
    pytest.mark.timeout(3000),  # the first run bootstraps Debian and downloads the packages
    pytest.mark.skipif(debian_root.missing() is not None, reason=str(debian_root.missing())),
]
ROOT: Final = Path(__file__).parents[3]
PAGE: Final = ROOT / "docs/how-to/service.md"
NOT_TYPED: Final = ("sudo nano ", "sudo systemctl ")
"""An editor, and what needs a running systemd, which the service lab has."""
BUNDLE: Final = "sudo sh bundle/install.sh --public-key signer.pem"
LIVE: Final = "sudo timberhand demo"
PATIENT: Final = " --max-stops 120 --limit-s 240"
"""A computer short of processor time stops the machine, rightly; the stand-in operator arms it again each time."""


def shown(heading: str) -> list[str]:
    """The commands below a heading of the page, up to the next one, without their comments."""
    text = PAGE.read_text().split(f"\n{heading}\n")[1]
    section = re.split(r"(?m)^#{2,3} ", text)[0]
    return [re.sub(r"\s{2,}# .*", "", line) for line in re.findall(r"(?m)^    (\S.*)$", section)]


PREREQUISITES, *INSTALL = shown("## Install")
DEB: Final = next(line for line in INSTALL if ".deb" in line)
TRY: Final = shown("### Try it without a machine")


@dataclass(frozen=True, slots=True)
class Brought:
    """What the maker of the release hands over, and the root that the page's first line prepared."""

    made: Path
    bundle: Path
    deb: Path
    signer: Path

    def root(self, folder: Path) -> DebianRoot:
        """A new root whose user has the files in the home folder."""
        root = DebianRoot.new(self.made, folder)
        for file in (self.bundle, self.deb, self.signer):
            shutil.copy(file, root.stick)
            (root.stick / file.name).chmod(0o644)
        succeeds(root, "ln -s /mnt/* .")
        return root

    def named(self, line: str) -> str:
        """The page's line with the names of these files."""
        line = re.sub(r"timberhand-[\d.]+-[0-9a-f]{12}\.tar", self.bundle.name, line)
        return re.sub(r"timberhand_[\d.]+-[0-9a-f]{12}_\w+\.deb", self.deb.name, line)


def succeeds(root: DebianRoot, line: str, timeout_s: float = 600.0) -> str:
    """What a line prints that must succeed."""
    done = root.type(line, timeout_s)
    assert done.returncode == 0, f"{line}\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def brought(tmp_path_factory: pytest.TempPathFactory) -> Brought:
    folder = tmp_path_factory.mktemp("release")
    private, signer = make_keys(folder / "keys")
    wheel = build_wheel(folder)  # not compiled: a compiler takes minutes
    kept = debian_root.cache() / f"wheels-{sums.sha256_of(ROOT / 'deploy/lock/plant.txt')[:12]}"
    try:
        made = debian_root.make_root(PREREQUISITES)
        bundle = bundles.make(wheel, private, folder, kept if kept.is_dir() else None, bundles.Lock.PLANT)
    except (OSError, CommandFailed) as error:
        pytest.skip(f"no Debian or no packages without a network, the first time: {error}")
    if not kept.is_dir():
        _keep_packages(bundle, kept)
    command = ["sh", ROOT / "deploy/deb/build.sh", bundle, signer, folder]
    deb = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    return Brought(made, bundle, Path(deb), signer)


def _keep_packages(bundle: Path, kept: Path) -> None:
    unfinished = kept.with_suffix(".new")
    unfinished.mkdir(parents=True)
    with tarfile.open(bundle) as archive:
        for member in archive:
            name = Path(member.name).name
            if name.endswith(".whl") and not name.startswith("timberhand-"):
                file = archive.extractfile(member)
                assert file is not None
                (unfinished / name).write_bytes(file.read())
    unfinished.rename(kept)


@pytest.fixture(scope="module")
def installed(brought: Brought, tmp_path_factory: pytest.TempPathFactory) -> Iterator[DebianRoot]:
    """A root in which somebody typed the page's lines for a bundle."""
    folder = tmp_path_factory.mktemp("bundle") / "root"
    root = brought.root(folder)
    for line in INSTALL:
        if line.startswith(NOT_TYPED) or line == DEB:
            continue
        done = root.type(brought.named(line), 900.0)
        if line == BUNDLE:  # as everywhere but in a root without systemd; the page says what to do there
            assert done.returncode == ExitCode.CONFIGURATION and "--root /" in done.stderr, done.stderr
        else:
            assert done.returncode == 0, f"{line}\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
    yield root
    shutil.rmtree(folder)


def test_the_page_is_typed_from_its_first_line_to_the_crane() -> None:
    assert PREREQUISITES.startswith("sudo apt-get install ")
    assert BUNDLE in INSTALL and f"{BUNDLE} --root /" in INSTALL and f"{BUNDLE} --dry-run" in INSTALL
    needs = re.findall(r"(?m)^Depends: (.*)$", (ROOT / "deploy/deb/control").read_text())[0].split(", ")
    assert set(PREREQUISITES.split()[3:]) == {need for need in needs if " " not in need}, "as the Debian package"


def test_a_bundle_brings_a_crane_that_lays_a_log_into_the_bunk(installed: DebianRoot) -> None:
    succeeds(installed, next(line for line in TRY if "--lockstep" in line))


def test_the_doctor_finds_no_fault_in_what_was_installed(installed: DebianRoot) -> None:
    found = json.loads(succeeds(installed, next(line for line in TRY if "doctor" in line)))["installation"]
    assert [finding for finding in found if finding["severity"] == "fault"] == []
    signed = [finding["severity"] for finding in found if finding["what"] == "signature"]
    assert signed == ["fine"], found


def test_the_same_live_with_every_process_of_its_own(installed: DebianRoot) -> None:
    assert LIVE in TRY
    succeeds(installed, LIVE + " --live --detector perfect" + PATIENT, 400.0)


def test_the_debian_package_installs_the_same_and_takes_it_away(brought: Brought, tmp_path: Path) -> None:
    root = brought.root(tmp_path / "root")
    succeeds(root, brought.named(DEB), 900.0)
    assert succeeds(root, "timberhand --version").strip()
    succeeds(root, "timberhand config check")
    succeeds(root, "yes | sudo apt-get remove timberhand")
    gone = root.type("timberhand --version || ls /opt/timberhand")
    assert gone.returncode != 0
    shutil.rmtree(tmp_path / "root")
