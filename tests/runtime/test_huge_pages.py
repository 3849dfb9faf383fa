"""Huge pages: which memory is put on them, and that the kernel really does so."""

from runtime.memory import collapse_heap, huge_places

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
