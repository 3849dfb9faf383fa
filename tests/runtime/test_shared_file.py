"""Files in shared memory: only in a folder that no other user made first."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from runtime.shared_file import SharedFile, make_own_folder


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can make a folder of another user")
def test_a_folder_that_another_user_made_first_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trap = tmp_path / "timberhand-1000"
    trap.mkdir()
    os.chown(trap, 4321, 4321)
    with pytest.raises(PermissionError):
        SharedFile(trap / "controller.timing", 64)
    assert list(trap.iterdir()) == []
    os.chown(trap, 0, 0)
    monkeypatch.setattr(os, "getuid", lambda: 1000)
    make_own_folder(trap)  # root made it for this user


def test_a_file_is_made_with_its_folder_and_goes_with_its_owner(tmp_path: Path) -> None:
    file = SharedFile(tmp_path / "new" / "folder" / "page", 64)
    assert (tmp_path / "new/folder/page").read_bytes() == bytes(64)
    file.close()
    assert list((tmp_path / "new/folder").iterdir()) == []
