"""Freed memory stays with the process."""

import subprocess
import sys

COUNT = """
import resource, sys
from runtime.memory import keep_memory
if sys.argv[1] == "kept":
    keep_memory()
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(4):
        bytearray(64 << 20)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults()
print(faults())
"""


def counted(how: str) -> int:
    run = subprocess.run([sys.executable, "-c", COUNT, how], capture_output=True, text=True, check=True)
    return int(run.stdout)


def test_a_repeated_allocation_needs_no_new_pages():
    assert counted("kept") < 100, "page faults of four times 64 MB"
    assert counted("as it is") > 100, "else there is nothing to be kept"
