"""Bundles: what was signed is what is installed, and nothing else; Debian's own tools agree."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from host.release import bundle as bundles
from host.release import sums
from tests.host.small_releases import keys, small_bundle, small_wheel


@pytest.fixture
def unpacked(tmp_path: Path) -> tuple[Path, Path, Path]:
    """An unpacked bundle, the private and the public key."""
    private, public = keys(tmp_path)
    bundles.unpack(small_bundle(tmp_path, "1.0", private), tmp_path / "unpacked")
    return tmp_path / "unpacked", private, public


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is missing (apt-get install openssl)")
def test_debian_s_openssl_and_sha256sum_check_a_bundle_too(unpacked: tuple[Path, Path, Path]) -> None:
    folder, _, public = unpacked
    command = ["openssl", "pkeyutl", "-verify", "-pubin", "-inkey", public, "-rawin", "-in", bundles.SUMS]
    command += ["-sigfile", f"{bundles.SUMS}.sig"]

    def openssl() -> int:
        return subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode

    assert openssl() == 0
    subprocess.run(["sha256sum", "--check", "--strict", "--status", bundles.SUMS], cwd=folder, check=True)
    (folder / bundles.SUMS).write_text("")
    assert openssl() != 0


def test_the_list_of_parts_is_cyclonedx_with_the_hash_of_every_wheel(tmp_path: Path) -> None:
    private, _ = keys(tmp_path)
    wheel = small_wheel(tmp_path, "1.0")
    bundles.unpack(bundles.make(wheel, private, tmp_path, None, None), tmp_path / "unpacked")
    found = json.loads((tmp_path / "unpacked" / bundles.SBOM).read_text())
    assert found["bomFormat"] == "CycloneDX"
    (part,) = found["components"]
    assert (part["name"], part["version"]) == ("timberhand", "1.0")
    assert sums.sha256_of(wheel) in json.dumps(part)
