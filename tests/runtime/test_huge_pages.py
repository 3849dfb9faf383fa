"""Huge pages: which memory is put on them, and that the kernel really does so."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from runtime.huge_pages import collapse_heap, huge_places

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


def test_a_process_keeps_its_memory_and_has_it_on_huge_pages():
    if not Path("/sys/kernel/mm/transparent_hugepage").is_dir():
        pytest.skip("this kernel has no transparent huge pages")
    script = (
        "from runtime.huge_pages import collapse_heap\n"
        "kept = [bytes([k % 251]) * 100 for k in range(300_000)]\n"
        "print(collapse_heap(), all(kept[k] == bytes([k % 251]) * 100 for k in range(300_000)))\n"
        "print(open('/proc/self/smaps_rollup').read())\n"
    )
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    bytes_, same, *_ = told.split()
    assert same == "True"
    if bytes_ == "0":
        pytest.skip("this kernel collapses no memory (it is older than 6.1, or has no huge page free)")
    on_huge = re.search(r"AnonHugePages:\s+(\d+) kB", told)
    # Not how many: a busy machine has few huge pages free, and each one that it gives counts.
    assert on_huge and int(on_huge[1]) * 1024 >= int(bytes_) > 0


def test_a_kernel_without_huge_pages_is_no_error(monkeypatch, tmp_path):
    monkeypatch.setattr("runtime.huge_pages._HUGE_PAGE_BYTES", tmp_path / "none")
    assert collapse_heap() == 0
