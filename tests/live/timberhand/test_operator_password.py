"""``timberhand operator password``: the account is written, replaced, and refused with a sentence."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from console.accounts import Role, read_accounts


def password(secret: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "timberhand", "operator", "password", *map(str, arguments)]
    return subprocess.run(command, input=secret + "\n", capture_output=True, text=True, timeout=60)


def test_an_account_is_added_and_replaced(tmp_path: Path) -> None:
    path = tmp_path / "page.passwords"
    assert password("hemlock and spruce", "anna", "--role", "viewer", "--file", path).returncode == 0
    assert password("a second password", "anna", "--role", "technician", "--file", path).returncode == 0
    assert path.stat().st_mode & 0o777 == 0o600 and list(tmp_path.iterdir()) == [path]
    accounts = read_accounts(path)
    person = accounts.check("anna", "a second password")
    assert accounts.names == ["anna"] and person is not None and person.role is Role.TECHNICIAN


def test_a_short_password_and_an_unwritable_file_are_refused(tmp_path: Path) -> None:
    short = password("short", "anna", "--role", "viewer", "--file", tmp_path / "a")
    assert short.returncode == 2 and "accounts.password" in short.stderr and not (tmp_path / "a").exists()
    nowhere = password("hemlock and spruce", "anna", "--role", "viewer", "--file", tmp_path / "none" / "a")
    assert nowhere.returncode == 3 and "operator.accounts-file" in nowhere.stderr
