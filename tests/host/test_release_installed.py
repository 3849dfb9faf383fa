"""What is installed is compared with what was signed: every file of the program, and the machine's own files."""

from __future__ import annotations

import errno
import os
import shutil
import stat
import zipfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from host.doctor import installation
from host.doctor.finding import Severity
from host.exit_codes import CommandFailed, ExitCode
from host.release import bundle as bundles
from host.release import installed, machine_files, services, sums, updater
from host.release.signature import make_keys, sign
from tests.codes import coded
from tests.host.small_releases import DECISIVE, keys, small_bundle
from timberhand.cli import app
from timberhand.configuration.settings_file import SHIPPED

MACHINE = Path(__file__).parents[2] / "machine"
RUNNER = CliRunner()
SHIPPED_PROFILE = "machine/palms.toml"


@pytest.fixture
def program(tmp_path: Path) -> tuple[Path, Path, Path]:
    """The site-packages of an installed release, the private and the public key."""
    private, public = keys(tmp_path)
    bundle = tmp_path / "bundle"
    bundles.unpack(small_bundle(tmp_path, "1.0", private), bundle)
    tree = tmp_path / "opt/releases" / bundles.check(bundle, public).name
    site = tree / "lib/python3.11/site-packages"
    with zipfile.ZipFile(next((bundle / "wheels").iterdir())) as archive:
        archive.extractall(site)
    for name in ("SHA256SUMS", "SHA256SUMS.sig", "program.sha256", "release.json"):
        shutil.copy(bundle / name, tree)
    return site, private, public


def codes(program: Path, signer: Path, profile: str = SHIPPED_PROFILE) -> list[str]:
    return [problem.code for problem in installed.problems(signer, program / profile, program)]


def test_an_untouched_release_has_no_problem(program: tuple[Path, Path, Path]) -> None:
    site, _, public = program
    assert codes(site, public) == []
    assert installed.tree_of(site) == site.parents[2]


@pytest.mark.parametrize("name", DECISIVE)
def test_one_changed_byte_of_any_file_is_found(program: tuple[Path, Path, Path], name: str) -> None:
    site, _, public = program
    (site / name).write_bytes((site / name).read_bytes() + b" ")
    (found,) = installed.problems(public, site / SHIPPED_PROFILE, site)
    assert found.code == "installed.changed" and found.sentence.startswith(name)


def test_a_list_made_to_fit_and_another_signer_are_found(program: tuple[Path, Path, Path], tmp_path: Path) -> None:
    site, _, public = program
    tree = site.parents[2]
    (site / SHIPPED_PROFILE).write_text("mine\n")
    listed = sums.decode((tree / "program.sha256").read_text(), "")
    (tree / "program.sha256").write_text(sums.encode(sums.of_files(site, listed)))
    assert codes(site, public) == ["installed.changed"]
    whole = sums.decode((tree / "SHA256SUMS").read_text(), "")
    fitting = whole | sums.of_files(tree, ["program.sha256"])
    (tree / "SHA256SUMS").write_text(sums.encode(fitting))
    assert codes(site, public) == ["signature.bad"]
    other, _ = make_keys(tmp_path / "other")
    sign(tree / "SHA256SUMS", other)
    assert codes(site, public) == ["signature.bad"]
    (tree / "SHA256SUMS").unlink()
    assert codes(site, public) == ["installed.unsigned"]


def test_a_checkout_and_a_computer_without_a_signer_have_nothing_to_compare(program: tuple[Path, Path, Path]) -> None:
    site, _, public = program
    (site / SHIPPED_PROFILE).write_text("mine\n")
    assert codes(site, public.with_name("none.pem")) == []
    assert installed.tree_of(MACHINE.parent) is None
    assert list(installed.problems(public, MACHINE / "palms_471.toml")) == []


def machine(folder: Path, private: Path, title: str = "ours") -> Path:
    """A signed folder with a machine's own profile and envelope."""
    folder.mkdir()
    text = (MACHINE / "palms_471.toml").read_text().replace("\n", f"\n# {title}\n", 1)
    (folder / "profile.toml").write_text(text)
    shutil.copy(MACHINE / "palms_471.envelope.toml", folder)
    return signed(folder, private)


def signed(folder: Path, private: Path) -> Path:
    listed = folder / machine_files.SUMS
    listed.write_text(sums.encode(sums.of_files(folder, [path.name for path in folder.glob("*.toml")])))
    sign(listed, private)
    return folder


def test_a_machine_s_own_files_are_applied_checked_and_changed_back(
    program: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    site, private, public = program
    etc = tmp_path / "etc"
    etc.mkdir()
    with pytest.raises(CommandFailed, check=coded("machine-files.no-former")):
        machine_files.revert(public, etc)
    for title in ("first", "second"):
        profile = machine_files.apply(machine(tmp_path / title, private, title), public, etc)
        assert profile == etc / "machine/profile.toml" and f"# {title}" in profile.read_text()
        assert codes(site, public, str(profile)) == []
    machine_files.revert(public, etc)
    assert "# first" in profile.read_text() and os.readlink(etc / "machine") == "machine-a"
    machine_files.revert(public, etc)
    assert "# second" in profile.read_text()
    profile.write_text(profile.read_text() + "# by hand\n")
    assert codes(site, public, str(profile)) == ["machine-files.changed"]
    (tmp_path / "own.toml").write_text(profile.read_text())
    assert codes(site, public, str(tmp_path / "own.toml")) == ["machine-files.no-sums"]


@pytest.fixture
def applied(tmp_path: Path) -> tuple[Path, Path, Path]:
    """The place of machine files that were applied twice, so machine-b is in use; the private and the public key."""
    private, public = keys(tmp_path)
    (tmp_path / "etc").mkdir()
    for title in ("first", "second"):
        machine_files.apply(machine(tmp_path / title, private, title), public, tmp_path / "etc")
    return tmp_path / "etc", private, public


@pytest.mark.parametrize(("name", "title", "other"), [("machine-a", "first", "second"), ("machine", "second", "first")])
def test_files_that_lie_in_a_place_already_are_used_there(
    applied: tuple[Path, Path, Path], name: str, title: str, other: str
) -> None:
    etc, _, public = applied
    assert f"# {title}" in machine_files.apply(etc / name, public, etc).read_text()
    assert f"# {other}" in machine_files.revert(public, etc).read_text()


def test_the_services_may_read_machine_files_whatever_root_s_umask(
    applied: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    etc, private, public = applied
    third = machine(tmp_path / "third", private, "third")
    before = os.umask(0o077)
    try:
        profile = machine_files.apply(third, public, etc)
    finally:
        os.umask(before)
    assert stat.S_IMODE(profile.parent.stat().st_mode) == 0o755
    assert {stat.S_IMODE(path.stat().st_mode) for path in profile.parent.iterdir()} == {0o644}


def test_a_full_disk_leaves_the_files_in_use_and_the_former_ones(
    applied: tuple[Path, Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    etc, private, public = applied
    third = machine(tmp_path / "third", private, "third")

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch, pytest.raises(CommandFailed, check=coded("machine-files.not-written")):
        patch.setattr(Path, "write_bytes", full)
        machine_files.apply(third, public, etc)
    assert sorted(path.name for path in etc.iterdir()) == ["machine", "machine-a", "machine-b"]
    assert "# second" in (etc / "machine/profile.toml").read_text()
    assert "# first" in machine_files.revert(public, etc).read_text()


def test_files_that_are_not_signed_or_do_not_fit_are_refused_and_change_nothing(
    program: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    _, private, public = program
    etc = tmp_path / "etc"
    etc.mkdir()
    machine_files.apply(machine(tmp_path / "good", private), public, etc)

    def refused(folder: Path, code: str) -> None:
        with pytest.raises(CommandFailed, check=coded(code)) as found:
            machine_files.apply(folder, public, etc)
        assert found.value.exit_code == ExitCode.CONFIGURATION
        assert os.readlink(etc / "machine") == "machine-a" and not (etc / "machine-b").exists()

    changed = machine(tmp_path / "changed", private)
    (changed / "profile.toml").write_text((changed / "profile.toml").read_text() + "# by hand\n")
    refused(changed, "machine-files.changed")
    fast = machine(tmp_path / "fast", private)
    text = (fast / "profile.toml").read_text()
    limit = next(line for line in text.splitlines() if line.startswith("speed_limit"))
    (fast / "profile.toml").write_text(text.replace(limit, limit.split("=")[0] + "= 0.4", 1))
    refused(signed(fast, private), "guard.profile-exceeds-envelope")
    broken = machine(tmp_path / "broken", private)
    (broken / "profile.toml").write_text("nonsense")
    refused(signed(broken, private), "profile.broken-toml")
    nameless = machine(tmp_path / "nameless", private)
    (nameless / "profile.toml").rename(nameless / "mine.toml")
    refused(signed(nameless, private), "machine-files.no-profile")
    other, _ = make_keys(tmp_path / "other")
    refused(machine(tmp_path / "theirs", other), "signature.bad")


@pytest.mark.parametrize("command", [["apply", "DIR"], ["revert"]])
def test_machine_files_are_not_changed_while_the_machine_is_armed(
    monkeypatch: pytest.MonkeyPatch, command: list[str]
) -> None:
    monkeypatch.setattr(services, "service_mode", lambda: "ARMED")
    done = RUNNER.invoke(app, ["config", *command])
    assert isinstance(done.exception, CommandFailed) and done.exception.code == "update.armed"
    assert done.exception.exit_code == ExitCode.SAFETY_STOP


def test_config_check_and_doctor_tell_what_was_changed(
    program: tuple[Path, Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    site, _, public = program
    real = installed.problems
    monkeypatch.setattr(installed, "PROGRAM", site)
    monkeypatch.setattr(installed, "problems", lambda signer, _: real(signer, site / SHIPPED_PROFILE, site))
    monkeypatch.setattr(updater, "SIGNER", public)
    monkeypatch.setattr(installation, "SIGNER", public)
    assert RUNNER.invoke(app, ["config", "check", str(SHIPPED)]).exit_code == 0
    assert [finding.severity for finding in installation.signed()] == [Severity.FINE]
    (site / "can_dbc/crane.dbc").write_text("changed")
    done = RUNNER.invoke(app, ["config", "check", str(SHIPPED)])
    assert done.exit_code == ExitCode.CONFIGURATION and "can_dbc/crane.dbc" in done.stdout
    assert [finding.severity for finding in installation.signed()] == [Severity.CHANGE]
    monkeypatch.setattr(installation, "SIGNER", public.with_name("none"))
    assert [finding.severity for finding in installation.signed()] == [Severity.ADVICE]
