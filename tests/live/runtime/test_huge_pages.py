"""Huge pages: which memory is put on them, and that the kernel really does so."""

import re
import subprocess
import sys
from pathlib import Path

import pytest


def test_a_process_keeps_its_memory_and_has_it_on_huge_pages():
    if not Path("/sys/kernel/mm/transparent_hugepage").is_dir():
        pytest.skip("this kernel has no transparent huge pages")
    script = (
        "from runtime.memory import collapse_heap\n"
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
