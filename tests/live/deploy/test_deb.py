"""The Debian package: it carries the bundle, and its scripts install, update and remove with it."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.host.small_releases import keys, small_bundle

DEB = Path(__file__).parents[3] / "deploy" / "deb"
pytestmark = pytest.mark.skipif(shutil.which("dpkg-deb") is None, reason="dpkg-deb is missing (Debian only)")


def build(*words: object) -> subprocess.CompletedProcess[str]:
    command = ["sh", str(DEB / "build.sh"), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_the_package_carries_the_bundle_and_is_the_same_twice(tmp_path: Path) -> None:
    private, public = keys(tmp_path)
    bundle = small_bundle(tmp_path, "1.0", private)
    made = [build(bundle, public, tmp_path / name) for name in ("one", "two")]
    assert [done.returncode for done in made] == [0, 0], made[0].stderr
    one, two = (Path(done.stdout.strip()) for done in made)
    assert one.read_bytes() == two.read_bytes()
    version = bundle.name.removeprefix("timberhand-").removesuffix(".tar")
    architecture = subprocess.run(["dpkg", "--print-architecture"], capture_output=True, text=True, check=True)
    assert one.name == f"timberhand_{version}_{architecture.stdout.strip()}.deb"
    subprocess.run(["dpkg-deb", "--extract", one, tmp_path / "x"], check=True)
    subprocess.run(["dpkg-deb", "--control", one, tmp_path / "c"], check=True)
    share = tmp_path / "x/usr/share/timberhand"
    assert (share / "signer.pem").read_bytes() == public.read_bytes()
    subprocess.run(["sha256sum", "--check", "--strict", "--status", "SHA256SUMS"], cwd=share / "bundle", check=True)
    control = (tmp_path / "c/control").read_text()
    assert (
        f"Version: {version}\n" in control and "openssl" in control and "@" not in control.replace("<timberhand@", "")
    )
    for script in ("postinst", "prerm"):
        assert (tmp_path / "c" / script).stat().st_mode & 0o777 == 0o755


def test_what_is_no_bundle_is_one_sentence(tmp_path: Path) -> None:
    done = build(tmp_path / "none.tar", tmp_path / "none.pem")
    assert (done.returncode, done.stdout) == (2, "") and done.stderr.count("\n") == 1
