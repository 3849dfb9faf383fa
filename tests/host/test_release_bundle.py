"""Bundles: what was signed is what is installed, and nothing else; Debian's own tools agree."""

from __future__ import annotations

import errno
import io
import json
import os
import platform
import shutil
import tarfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from host.exit_codes import CommandFailed, ExitCode
from host.release import bundle as bundles
from host.release import sums
from host.release.signature import make_keys, sign, verify
from runtime.errors import InputRefused
from tests.codes import coded
from tests.host.small_releases import DECISIVE, keys, small_bundle, small_wheel
from timberhand.cli import app

RUNNER = CliRunner()


@pytest.fixture
def unpacked(tmp_path: Path) -> tuple[Path, Path, Path]:
    """An unpacked bundle, the private and the public key."""
    private, public = keys(tmp_path)
    bundles.unpack(small_bundle(tmp_path, "1.0", private), tmp_path / "unpacked")
    return tmp_path / "unpacked", private, public


def test_a_bundle_is_what_was_signed(unpacked: tuple[Path, Path, Path]) -> None:
    folder, _, public = unpacked
    release = bundles.check(folder, public)
    assert (release.version, release.machine) == ("1.0", platform.machine())
    wheel = folder / "wheels" / release.wheel
    assert release.name == f"1.0-{sums.sha256_of(wheel)[:12]}"
    assert set(DECISIVE) <= sums.decode((folder / bundles.PROGRAM_SUMS).read_text(), "").keys()
    text = (folder / bundles.REQUIREMENTS).read_text()
    assert text == f"timberhand==1.0 --hash=sha256:{sums.sha256_of(wheel)}\n"


@pytest.mark.parametrize("name", ["release.json", "program.sha256", "requirements.txt", "wheels", "sbom.cdx.json"])
def test_a_changed_file_is_refused(unpacked: tuple[Path, Path, Path], name: str) -> None:
    folder, _, public = unpacked
    path = folder / name if name != "wheels" else next((folder / "wheels").iterdir())
    path.write_bytes(path.read_bytes() + b" ")
    with pytest.raises(CommandFailed, check=coded("bundle.changed")) as refused:
        bundles.check(folder, public)
    assert refused.value.exit_code == ExitCode.CONFIGURATION


def test_a_missing_file_and_one_that_nobody_signed_are_refused(unpacked: tuple[Path, Path, Path]) -> None:
    folder, _, public = unpacked
    (folder / "wheels/extra.whl").write_bytes(b"")
    with pytest.raises(CommandFailed, match=r"extra\.whl", check=coded("bundle.changed")):
        bundles.check(folder, public)
    (folder / "wheels/extra.whl").unlink()
    (folder / "requirements.txt").unlink()
    with pytest.raises(CommandFailed, check=coded("bundle.changed")):
        bundles.check(folder, public)


def test_another_signer_and_a_changed_list_are_refused(unpacked: tuple[Path, Path, Path], tmp_path: Path) -> None:
    folder, private, public = unpacked
    _, other = make_keys(tmp_path / "other")
    with pytest.raises(CommandFailed, check=coded("signature.bad")):
        bundles.check(folder, other)
    listed = folder / bundles.SUMS
    text = listed.read_text()
    listed.write_text(text.replace("a", "b", 1))
    with pytest.raises(CommandFailed, check=coded("signature.bad")):
        bundles.check(folder, public)
    listed.write_text("nonsense\n")
    sign(listed, private)
    with pytest.raises(InputRefused, check=coded("sums.broken")):
        bundles.check(folder, public)
    for name in (bundles.SUMS + ".sig", bundles.SUMS):
        (folder / name).unlink()
        with pytest.raises(CommandFailed, check=coded("signature.bad" if "sig" in name else "bundle.no-sums")):
            bundles.check(folder, public)


def test_a_bundle_for_another_processor_is_refused(unpacked: tuple[Path, Path, Path]) -> None:
    folder, private, public = unpacked
    marker = folder / "release.json"
    marker.write_text(json.dumps(json.loads(marker.read_text()) | {"machine": "riscv64"}))
    names = sums.decode((folder / bundles.SUMS).read_text(), "").keys()
    (folder / bundles.SUMS).write_text(sums.encode(sums.of_files(folder, names)))
    sign(folder / bundles.SUMS, private)
    with pytest.raises(CommandFailed, check=coded("bundle.other-machine")):
        bundles.check_for_here(folder, public)
    verified = RUNNER.invoke(app, ["release", "verify", str(folder), "--public-key", str(public)])
    assert verified.exit_code == 0 and "riscv64" in verified.stdout, "who makes bundles for others verifies them, too"


def test_the_same_wheel_gives_the_same_bytes(tmp_path: Path) -> None:
    private, _ = keys(tmp_path)
    one = small_bundle(tmp_path / "one", "1.0", private)
    wheel = shutil.copy(tmp_path / "one/wheel/timberhand-1.0-py3-none-any.whl", tmp_path)
    os.utime(wheel, (1, 1))
    (tmp_path / "two").mkdir()
    shutil.copytree(tmp_path / "one/wheel", tmp_path / "two/wheel")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bundles, "_add_sbom", lambda place: (place / bundles.SBOM).write_text("{}\n"))
        two = bundles.make(Path(wheel), private, tmp_path / "two", None, None)
    assert one.read_bytes() == two.read_bytes()


def test_a_tar_file_writes_nothing_outside_its_folder(tmp_path: Path) -> None:
    path = tmp_path / "evil.tar"
    with tarfile.open(path, "w") as archive:
        for name in ("x/../../escaped", "/escaped", "x/a/../../../escaped", "x/good"):
            entry = tarfile.TarInfo(name)
            entry.size = 1
            archive.addfile(entry, io.BytesIO(b"x"))
        link = tarfile.TarInfo("x/link")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        archive.addfile(link)
    bundles.unpack(path, tmp_path / "in/here")
    assert [p.relative_to(tmp_path / "in").as_posix() for p in (tmp_path / "in").rglob("*")] == ["here", "here/good"]
    assert not (tmp_path / "escaped").exists()


def test_a_list_of_hashes_never_names_a_file_outside() -> None:
    digest = "0" * 64
    for line in (f"{digest}  ../x", f"{digest}  /etc/passwd", "x  y", f"{digest}  a\n{digest}  a"):
        with pytest.raises(InputRefused, check=coded("sums.broken")):
            sums.decode(line, "list")
    assert sums.decode(sums.encode({"b": digest, "a/c": digest}), "list") == {"a/c": digest, "b": digest}


def test_the_commands_make_keys_sign_and_check(tmp_path: Path) -> None:
    assert RUNNER.invoke(app, ["release", "keygen", str(tmp_path / "k")]).exit_code == 0
    private, public = tmp_path / "k/signing-key.pem", tmp_path / "k/signer.pem"
    assert private.stat().st_mode & 0o777 == 0o600
    again = RUNNER.invoke(app, ["release", "keygen", str(tmp_path / "k")])
    assert isinstance(again.exception, CommandFailed) and again.exception.code == "signature.key-exists"
    file = tmp_path / "list"
    file.write_text("x")
    assert RUNNER.invoke(app, ["release", "sign", str(file), "--key", str(private)]).exit_code == 0
    verify(file, public)
    with pytest.raises(CommandFailed, check=coded("signature.private-key")):
        sign(file, public)
    with pytest.raises(CommandFailed, check=coded("signature.public-key")):
        verify(file, private)
    bundle = small_bundle(tmp_path, "1.0", private)
    good = RUNNER.invoke(app, ["release", "verify", str(bundle), "--public-key", str(public)])
    assert good.exit_code == 0 and "good" in good.stdout
    with bundle.open("r+b") as archive:
        archive.seek(700)
        archive.write(b"?")
    bad = RUNNER.invoke(app, ["release", "verify", str(bundle), "--public-key", str(public)])
    assert isinstance(bad.exception, CommandFailed) and bad.exception.exit_code == ExitCode.CONFIGURATION


def test_what_is_no_wheel_and_what_is_no_bundle_is_one_sentence(tmp_path: Path) -> None:
    private, _ = keys(tmp_path)
    for name in ("msgspec-1.0-py3-none-any.whl", "timberhand.zip", "timberhand-1.0-py3-none-any.whl"):
        with pytest.raises(CommandFailed, check=coded("bundle.no-wheel")):
            bundles.make(tmp_path / name, private, tmp_path / "out", None, None)
    half = small_wheel(tmp_path, "1.0")
    half.write_bytes(half.read_bytes()[:-30])
    with pytest.raises(CommandFailed, check=coded("bundle.no-wheel")):
        bundles.make(half, private, tmp_path / "out", None, None)
    (tmp_path / "text").write_text("no tar file")
    with pytest.raises(CommandFailed, check=coded("bundle.no-bundle")):
        bundles.unpack(tmp_path / "text", tmp_path / "nothing")
    with pytest.raises(CommandFailed, check=coded("bundle.unreadable")):
        bundles.unpack(tmp_path / "none.tar", tmp_path / "none")


def test_a_place_that_takes_no_bundle_is_one_sentence(tmp_path: Path) -> None:
    private, _ = keys(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(CommandFailed, match="Not a directory", check=coded("bundle.not-written")):
        bundles.make(small_wheel(tmp_path, "1.0"), private, tmp_path / "file/out", None, None)


def test_a_full_disk_leaves_no_part_of_a_bundle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    private, _ = keys(tmp_path)
    bundle = small_bundle(tmp_path, "1.0", private)
    before = bundle.read_bytes()

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tarfile.TarFile, "add", full)
    with pytest.raises(CommandFailed, match="No space", check=coded("bundle.not-written")):
        small_bundle(tmp_path, "1.0", private)
    assert list(tmp_path.glob("timberhand-*")) == [bundle] and bundle.read_bytes() == before


def test_a_file_to_sign_that_is_missing_is_named(tmp_path: Path) -> None:
    private, _ = keys(tmp_path)
    with pytest.raises(CommandFailed, match=r"none\.txt cannot be read", check=coded("signature.unreadable")):
        sign(tmp_path / "none.txt", private)


def test_a_folder_that_is_no_bundle_is_not_read_through(tmp_path: Path) -> None:
    (tmp_path / "dangling").symlink_to("nowhere")
    refused = RUNNER.invoke(app, ["release", "verify", str(tmp_path)]).exception
    assert isinstance(refused, CommandFailed) and refused.code == "bundle.no-sums"
