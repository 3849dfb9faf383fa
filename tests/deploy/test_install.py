"""The installation into a separate tree, with a small wheel, and its messages."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from host.service_lab.host import build_wheel

DEPLOY = Path(__file__).parents[2] / "deploy"
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
    """What lies in a tree, without the program's own folders."""
    found = (p for p in root.rglob("*") if not p.is_dir() or p.is_symlink())
    names = {str(p.relative_to(root)) for p in found}
    return {name for name in names if not name.startswith("opt/timberhand/")}


@pytest.mark.slow
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
    assert "nothing runs yet and nothing is armed" in first.stderr
    units = [unit.name for unit in (DEPLOY / "units").iterdir()]
    there = files(root)
    assert {f"usr/lib/systemd/system/{unit}" for unit in units} <= there
    assert "usr/lib/systemd/catalog/timberhand.catalog" in there
    wants = {unit for unit in units if unit.endswith(".service") and "@" not in unit}
    assert {f"etc/systemd/system/timberhand.target.wants/{unit}" for unit in wants} <= there
    assert "etc/systemd/system/multi-user.target.wants/timberhand.target" in there
    assert os.readlink(root / "usr/local/bin/timberhand") == "/opt/timberhand/bin/timberhand"
    program = root / "opt/timberhand/bin/python"
    said = subprocess.run([program, "-P", "-m", "controller"], cwd="/", capture_output=True, text=True, check=True)
    assert said.stdout == "here\n"
    assert (root / "opt/timberhand/bin/timberhand").read_text().startswith("#!/opt/timberhand/bin/python")

    again = install(*words)
    assert again.returncode == 0, again.stderr
    assert files(root) == there

    units_of = root / "usr/lib/systemd/system"
    (units_of / units[0]).unlink()
    mended = subprocess.run(  # by the installed program itself, which keeps the packages that it was given
        [program, "-P", "-m", "deploy", *from_wheel[:2], "--python", sys.executable, "--find-links", root],
        capture_output=True, text=True, check=False, cwd="/",
    )  # fmt: skip
    assert mended.returncode == 0, mended.stderr
    assert files(root) == there

    conf = root / "etc/timberhand/timberhand.conf"
    conf.write_text(conf.read_text() + "PROFILE=mine\n")
    edited = conf.read_text()
    assert "stays as it is" in install(*words).stderr
    assert conf.read_text() == edited
    (root / "usr/lib/timberhand/timberhand.conf").write_text("# an older release\n")
    assert "the new version lies beside it" in install(*words).stderr
    assert (conf.read_text(), (conf.parent / "timberhand.conf.new").exists()) == (edited, True)

    removed = install("--root", root, "--uninstall")
    assert removed.returncode == 0, removed.stderr
    assert files(root) == {"etc/timberhand/timberhand.conf"}
    assert not (root / "opt/timberhand").exists()
    assert "was changed here and stays" in removed.stderr


def test_a_dry_run_prints_every_step_and_executes_none(tmp_path: Path, wheel: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    done = install("--dry-run", "--root", root, "--wheel", wheel)
    assert done.returncode == 0, done.stderr
    assert list(root.iterdir()) == []
    for unit in (DEPLOY / "units").iterdir():
        assert f"install -D -m 0644 {unit} {root}/usr/lib/systemd/system/{unit.name}" in done.stdout
    assert f"{root}/usr/lib/systemd/catalog/timberhand.catalog" in done.stdout
    assert f"systemctl --quiet --root={root} enable" in done.stdout
    gone = install("--dry-run", "--root", root, "--uninstall")
    assert gone.returncode == 0 and f"{root}/opt/timberhand" in gone.stdout


@pytest.mark.parametrize(
    ("words", "status", "sentence"),
    [
        (["--force"], 2, "there is no option --force"),
        (["--wheel"], 2, "--wheel needs a value"),
        (["--dry-run", "--wheel", "/nowhere.whl"], 2, "--wheel /nowhere.whl is no file"),
        (["--dry-run", "--find-links", "/nowhere"], 2, "--find-links /nowhere is no directory"),
        (["--dry-run", "--root", "/nowhere"], 2, "--root /nowhere is no directory"),
        (["--dry-run", "--root", "/tmp", "--from-environment", "/proc"], 2, "holds no Python packages"),
        (["--dry-run", "--root", "/tmp", "--python", "false"], 3, "false is older than Python 3.11"),
    ],
)
def test_every_usage_error_is_one_sentence(words: list[str], status: int, sentence: str) -> None:
    done = install(*words)
    assert (done.returncode, done.stdout) == (status, "")
    assert sentence in done.stderr and done.stderr.count("\n") == 1


def test_an_unpacked_wheel_cannot_be_built(tmp_path: Path) -> None:
    shutil.copytree(DEPLOY, tmp_path / "deploy", ignore=shutil.ignore_patterns("__pycache__"))
    script = tmp_path / "deploy/install.sh"
    done = subprocess.run(["sh", script, "--dry-run"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert "name a wheel with --wheel FILE" in done.stderr and done.stderr.count("\n") == 1


@pytest.mark.slow
def test_the_real_wheel_contains_everything_that_is_installed(tmp_path: Path) -> None:
    wheel = build_wheel(tmp_path)
    shipped = set(zipfile.ZipFile(wheel).namelist())
    wanted = [file for name in ("units", "system") for file in (DEPLOY / name).iterdir()]
    wanted += [DEPLOY / name for name in ("install.sh", "timberhand.conf", "constraints.txt", "__main__.py")]
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
    assert "lies in a home directory" in done.stderr


def test_help_needs_nothing() -> None:
    assert "--uninstall" in install("--help").stdout
