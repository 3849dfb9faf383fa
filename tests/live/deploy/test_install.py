"""The installation into a separate tree, with a small wheel, and its messages."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from host.release import bundle as bundles
from host.release import installed
from host.release.signature import make_keys
from host.service_lab.host import build_wheel
from tests.host.small_releases import keys, small_bundle

DEPLOY = Path(__file__).parents[3] / "deploy"
INSTALL = DEPLOY / "install.sh"
METADATA = (
    "Metadata-Version: 2.1\nName: timberhand\nVersion: 0.1.0\nProvides-Extra: autonomy\nProvides-Extra: console\n"
    "Requires-Dist: msgspec\n"
)


def install(*words: object, python: str = sys.executable) -> subprocess.CompletedProcess[str]:
    command = ["sh", str(INSTALL), "--python", python, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture
def wheel(tmp_path: Path) -> Path:
    """A wheel with one module, what the real one says of itself, and what it lays out."""
    path = tmp_path / "timberhand-0.1.0-py3-none-any.whl"
    info = "timberhand-0.1.0.dist-info"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("controller/__main__.py", "import msgspec\nprint('here')\n")
        archive.writestr(f"{info}/METADATA", METADATA)
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{info}/entry_points.txt", "[console_scripts]\ntimberhand = controller.__main__:main\n")
        archive.writestr(f"{info}/RECORD", "")
        for file in DEPLOY.rglob("*"):
            if file.is_file() and "__pycache__" not in file.parts:
                archive.write(file, Path("deploy", file.relative_to(DEPLOY)))
    return path


def files(root: Path) -> set[str]:
    """What lies in a tree, without the releases."""
    found = (p for p in root.rglob("*") if not p.is_dir() or p.is_symlink())
    names = {str(p.relative_to(root)) for p in found}
    return {name for name in names if not name.startswith("opt/timberhand/")}


@pytest.mark.timeout(400)
@pytest.mark.skipif(shutil.which("systemctl") is None, reason="systemctl is missing (apt-get install systemd)")
def test_install_twice_change_settings_and_remove(tmp_path: Path, wheel: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    words = ("--root", root, "--wheel", wheel, "--from-environment", sys.prefix)
    from_wheel = ("--root", root, "--from-environment", sys.prefix, "--python", sys.executable)
    first = subprocess.run(  # with nothing but the wheel
        [sys.executable, wheel / "deploy", *from_wheel], capture_output=True, text=True, check=False, cwd="/"
    )
    assert first.returncode == 0, first.stderr
    units = [unit.name for unit in (DEPLOY / "units").iterdir()]
    there = files(root)
    assert {f"usr/lib/systemd/system/{unit}" for unit in units} <= there
    assert "usr/lib/systemd/catalog/timberhand.catalog" in there
    wants = {unit for unit in units if unit.endswith(".service") and "@" not in unit}
    assert {f"etc/systemd/system/timberhand.target.wants/{unit}" for unit in wants} <= there
    assert "etc/systemd/system/multi-user.target.wants/timberhand.target" in there
    assert os.readlink(root / "usr/local/bin/timberhand") == "/opt/timberhand/current/bin/timberhand"
    for name in there - {"etc/timberhand/key", "etc/timberhand/timberhand.conf"}:
        if not name.startswith(("etc/systemd/", "opt/")):  # one rename changes all of it
            assert os.readlink(root / name).startswith("/opt/timberhand/current/"), name
            assert (root / os.readlink(root / name).lstrip("/")).is_file(), name
    release = f"0.1.0-{hashlib.sha256(wheel.read_bytes()).hexdigest()[:12]}"
    assert os.readlink(root / "opt/timberhand/current") == f"releases/{release}"
    assert json.loads((root / "opt/timberhand/current/release.json").read_text()) == {
        "name": release,
        "version": "0.1.0",
    }
    program = root / "opt/timberhand/current/bin/python"
    said = subprocess.run([program, "-P", "-m", "controller"], cwd="/", capture_output=True, text=True, check=True)
    assert said.stdout == "here\n"
    script = (root / "opt/timberhand/current/bin/timberhand").read_text()
    assert script.startswith(f"#!/opt/timberhand/releases/{release}/bin/python")

    assert (
        os.path.realpath(sys.base_prefix) == "/usr"
        or os.path.realpath(sys.base_prefix)
        in (root / "etc/systemd/system/timberhand-.service.d/50-program.conf").read_text()
    )
    key = root / "etc/timberhand/key"
    secret = key.read_bytes()
    assert len(secret) == 44 and key.stat().st_mode & 0o777 == 0o440

    again = install(*words)
    assert again.returncode == 0, again.stderr
    assert files(root) == there
    assert key.read_bytes() == secret, "an update keeps the key"

    units_of = root / "usr/lib/systemd/system"
    (units_of / units[0]).unlink()
    mended = subprocess.run(  # by the installed program itself, which keeps the packages that it was given
        [program, "-P", "-m", "deploy", *from_wheel[:2], "--python", sys.executable, "--find-links", root],
        capture_output=True,
        text=True,
        check=False,
        cwd="/",
    )
    assert mended.returncode == 0, mended.stderr
    assert files(root) == there
    assert install(*words, "--cpu", "0").returncode == 0
    pinned = root / "etc/systemd/system/timberhand-controller.service.d/50-processor.conf"
    assert pinned.read_text() == "[Service]\nCPUAffinity=0\n"

    conf = root / "etc/timberhand/timberhand.conf"
    conf.write_text(conf.read_text() + "PROFILE=mine\n")
    edited = conf.read_text()
    assert "timberhand.conf" in install(*words).stderr
    assert conf.read_text() == edited

    with zipfile.ZipFile(wheel, "a") as archive:
        archive.writestr("controller/more.py", "")
    assert install(*words).returncode == 0
    assert os.readlink(root / "opt/timberhand/previous") == f"releases/{release}"
    assert os.readlink(root / "opt/timberhand/current") != f"releases/{release}"

    removed = install("--root", root, "--uninstall")
    assert removed.returncode == 0, removed.stderr
    assert files(root) == {"etc/timberhand/timberhand.conf"}
    assert not (root / "opt/timberhand").exists()
    assert "timberhand.conf" in removed.stderr


def test_a_dry_run_prints_every_step_and_executes_none(tmp_path: Path, wheel: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    done = install("--dry-run", "--root", root, "--wheel", wheel)
    assert done.returncode == 0, done.stderr
    assert list(root.iterdir()) == []
    for unit in (DEPLOY / "units").iterdir():
        link = f"/opt/timberhand/current/deploy/units/{unit.name} {root}/usr/lib/systemd/system/{unit.name}"
        assert f"ln -sfn {link}" in done.stdout
    assert f"{root}/usr/lib/systemd/catalog/timberhand.catalog" in done.stdout
    assert f"systemctl --quiet --root={root} enable" in done.stdout
    gone = install("--dry-run", "--root", root, "--uninstall")
    assert gone.returncode == 0 and f"{root}/opt/timberhand" in gone.stdout


@pytest.mark.parametrize(
    ("words", "status", "named"),
    [
        (["--force"], 2, "--force"),
        (["--wheel"], 2, "--wheel"),
        (["--dry-run", "--wheel", "/nowhere.whl"], 2, "--wheel /nowhere.whl"),
        (["--dry-run", "--find-links", "/nowhere"], 2, "--find-links /nowhere"),
        (["--dry-run", "--root", "/nowhere"], 2, "--root /nowhere"),
        (["--dry-run", "--bundle", "/nowhere"], 2, "SHA256SUMS"),
        (["--dry-run", "--root", "/tmp", "--from-environment", "/proc"], 2, "/proc"),
        (["--dry-run", "--cpu", "two"], 2, "--cpu two"),
        (["--dry-run", "--cpu", "4321"], 2, "4321"),
        (["--dry-run", "--root", "/tmp", "--python", "false"], 3, "3.11"),
    ],
)
def test_every_usage_error_is_one_sentence(words: list[str], status: int, named: str) -> None:
    done = install(*words)
    assert (done.returncode, done.stdout) == (status, "")
    assert named in done.stderr and done.stderr.count("\n") == 1


def pinned_by(stdout: str) -> list[str]:
    """The processors that the steps of a dry run give the controller."""
    return re.findall(r"CPUAffinity=%s\n' '(\S+)' > '.*/timberhand-controller\.service\.d/50-processor\.conf'", stdout)


def test_the_controller_s_processor_is_a_choice_that_a_repair_keeps(tmp_path: Path, wheel: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    words = ("--dry-run", "--root", root, "--wheel", wheel)
    assert "50-processor" not in install(*words).stdout, "as it is"
    assert pinned_by(install(*words, "--cpu", "1").stdout) == ["1"]
    assert f"rm -f {root}/etc/systemd/system/timberhand-controller.service.d/50-processor.conf" in (
        install(*words, "--cpu", "any").stdout
    )


@pytest.mark.parametrize(("isolated", "pinned"), [("", []), ("3", ["3"]), ("1,4-7", ["7"])])
def test_the_first_installation_takes_a_processor_that_the_kernel_isolates(
    tmp_path: Path, wheel: Path, isolated: str, pinned: list[str]
) -> None:
    shutil.copytree(DEPLOY, tmp_path / "deploy", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "isolated").write_text(f"{isolated}\n")
    script = tmp_path / "deploy/install.sh"
    text = script.read_text().replace("processors=/sys/devices/system/cpu", f"processors={tmp_path}")
    script.write_text(text.replace("etc=$root/etc/timberhand", f"etc={tmp_path}/etc"))
    python = tmp_path / "python"  # in no home directory
    python.write_text(
        f'#!/bin/sh\ncase $2 in *realpath*) echo /usr/bin/python3 ;; *) exec {sys.executable} "$@" ;; esac\n'
    )
    python.chmod(0o755)
    command = ["sh", script, "--dry-run", "--python", python, "--wheel", wheel]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert pinned_by(done.stdout) == pinned and ("50-processor" in done.stdout) == bool(pinned)
    assert ("isolates" in done.stderr) == bool(pinned)


def test_a_bundle_for_another_python_is_refused_in_one_sentence(bundle: tuple[Path, Path, Path]) -> None:
    folder, public, root = bundle
    other = f"3{sys.version_info.minor + 1}"
    (folder / f"wheels/numpy-2.0-cp{other}-cp{other}-manylinux_2_28_x86_64.whl").touch()
    done = install("--dry-run", "--tree", "--root", root, "--bundle", folder, "--public-key", public)
    assert done.returncode == 3 and f"3.{sys.version_info.minor + 1}" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_bundle_installs_itself(bundle: tuple[Path, Path, Path]) -> None:
    folder, public, root = bundle
    words = ["--dry-run", "--public-key", public, "--root", root, "--python", sys.executable]
    done = subprocess.run(["sh", folder / "install.sh", *words], capture_output=True, text=True, check=False, cwd="/")
    assert done.returncode == 0, done.stderr
    assert f"{root}/opt/timberhand/current" in done.stdout


def test_an_unpacked_wheel_cannot_be_built(tmp_path: Path) -> None:
    shutil.copytree(DEPLOY, tmp_path / "deploy", ignore=shutil.ignore_patterns("__pycache__"))
    script = tmp_path / "deploy/install.sh"
    done = subprocess.run(["sh", script, "--dry-run"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert "--wheel" in done.stderr and done.stderr.count("\n") == 1


def test_the_real_wheel_contains_everything_that_is_installed(tmp_path: Path) -> None:
    wheel = build_wheel(tmp_path)
    shipped = set(zipfile.ZipFile(wheel).namelist())
    wanted = [file for name in ("units", "system") for file in (DEPLOY / name).iterdir()]
    wanted += [DEPLOY / name for name in ("install.sh", "timberhand.conf", "lock/machine.txt", "__main__.py")]
    assert {str(Path("deploy", file.relative_to(DEPLOY))) for file in wanted} <= shipped
    done = subprocess.run([sys.executable, wheel / "deploy", "--help"], capture_output=True, text=True, check=True)
    assert "timberhand-VERSION.whl/deploy" in done.stdout


def test_a_python_in_a_home_directory_is_refused(tmp_path: Path) -> None:
    """The services run with every home directory hidden."""
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\ncase $2 in *realpath*) echo /home/me/bin/python ;; esac\n")
    python.chmod(0o755)
    done = install("--dry-run", python=str(python))
    assert done.returncode == 3
    assert str(python) in done.stderr


def test_help_needs_nothing() -> None:
    assert "--uninstall" in install("--help").stdout


@pytest.fixture
def bundle(tmp_path: Path) -> tuple[Path, Path, Path]:
    """A small bundle, unpacked, its signer's public key, and an empty tree to install into."""
    private, public = keys(tmp_path)
    bundles.unpack(small_bundle(tmp_path, "1.0", private, DEPLOY), tmp_path / "bundle")
    (tmp_path / "root").mkdir()
    return tmp_path / "bundle", public, tmp_path / "root"


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is missing (apt-get install openssl)")
def test_a_bundle_is_installed_only_with_a_good_signature_and_every_file_as_signed(
    bundle: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    folder, public, root = bundle
    words = ("--dry-run", "--root", root, "--bundle", folder)
    _, other = make_keys(tmp_path / "other")

    def refused(*key: object) -> None:
        done = install(*words, *key)
        assert done.returncode == 3 and done.stderr.count("\n") == 1, done.stderr
        assert list(root.iterdir()) == []

    assert install(*words, "--public-key", public).returncode == 0
    refused()
    refused("--public-key", other)
    weights = folder / "release.json"
    weights.write_text(weights.read_text() + " ")
    refused("--public-key", public)
    (folder / "SHA256SUMS").write_text((folder / "SHA256SUMS").read_text() + "\n")
    refused("--public-key", public)
    (root / "etc/timberhand").mkdir(parents=True)
    shutil.copy(other, root / "etc/timberhand/signer.pem")
    done = install(*words, "--public-key", public)
    assert done.returncode == 3 and "signer.pem" in done.stderr


@pytest.mark.timeout(400)
@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is missing (apt-get install openssl)")
def test_a_bundle_s_release_is_whole_and_what_was_signed(bundle: tuple[Path, Path, Path]) -> None:
    folder, public, root = bundle
    done = install("--root", root, "--bundle", folder, "--public-key", public)
    assert done.returncode == 0, done.stderr
    tree = root / "opt/timberhand" / os.readlink(root / "opt/timberhand/current")
    site = tree / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"
    assert json.loads((tree / "release.json").read_text())["name"] == tree.name
    assert (root / "etc/timberhand/signer.pem").read_bytes() == public.read_bytes()
    assert list(installed.problems(public, site / "machine/palms.toml", site)) == []
    (site / "can_dbc/crane.dbc").write_text("changed")
    assert [problem.code for problem in installed.problems(public, site, site)] == ["installed.changed"]


@pytest.mark.skipif(shutil.which("systemctl") is None, reason="systemctl is missing (apt-get install systemd)")
def test_systemd_enables_units_that_are_links_through_the_release_in_use(tmp_path: Path) -> None:
    units = tmp_path / "usr/lib/systemd/system"
    units.mkdir(parents=True)
    release = tmp_path / "opt/timberhand/releases/one"
    shutil.copytree(DEPLOY / "units", release / "deploy/units")
    (tmp_path / "opt/timberhand/current").symlink_to("releases/one")
    names = [unit.name for unit in (DEPLOY / "units").iterdir()]
    for name in names:
        (units / name).symlink_to(f"/opt/timberhand/current/deploy/units/{name}")

    def systemctl(*words: str) -> str:
        command = ["systemctl", f"--root={tmp_path}", *words]
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout

    assert systemctl("is-enabled", "timberhand-controller.service").strip() != "enabled"
    systemctl("enable", "timberhand.target", "timberhand-controller.service")
    wants = tmp_path / "etc/systemd/system/timberhand.target.wants/timberhand-controller.service"
    assert wants.is_symlink()
    assert systemctl("is-enabled", "timberhand-controller.service").strip() == "enabled"
    systemctl("disable", "timberhand-controller.service")
    assert not wants.is_symlink() and (units / "timberhand-controller.service").is_symlink()
