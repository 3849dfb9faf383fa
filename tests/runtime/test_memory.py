"""Files in shared memory, only in a folder that no other user made first; and memory on huge pages."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from runtime.memory import collapse_heap, huge_places
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


# -- huge pages: which memory is put on them

SIZE = 0x200000
MAPS = """\
55d000000000-55d000900000 rw-p 00000000 00:00 0                          [heap]
7f0000100000-7f0000700000 rw-p 00000000 00:00 0
7f0001000000-7f0001200000 rw-p 00000000 00:00 0
7f0002000000-7f0002400000 r-xp 00000000 fe:00 12                         /usr/lib/libpython3.11.so.1.0
7f0003000000-7f0003400000 rw-p 00000000 fe:00 12                         /usr/lib/libpython3.11.so.1.0
7f0004000000-7f0004400000 rw-s 00000000 00:01 77                         /dev/shm/page
7f0005000000-7f0005400000 r--p 00000000 00:00 0
7ffe00000000-7ffe00400000 rw-p 00000000 00:00 0                          [stack]
"""


def test_only_own_writable_memory_is_taken_and_whole_pages_of_it():
    heap = [0x55D000000000 + k * SIZE for k in range(4)]
    assert list(huge_places(MAPS.splitlines(), SIZE)) == [*heap, 0x7F0000200000, 0x7F0000400000, 0x7F0001000000]


def test_a_kernel_without_huge_pages_is_no_error(monkeypatch, tmp_path):
    monkeypatch.setattr("runtime.memory._HUGE_PAGE_BYTES", tmp_path / "none")
    assert collapse_heap() == 0
