"""Parent of the user-mode kernel: when the kernel or the wrapper ends, all of the kernel's processes end.

The kernel is a process with many children, in a session of its own, which outlive it when it is killed; the
wrapper may be killed too.  This process waits for either (standard input is a pipe that only the wrapper holds
open) and then kills the kernel's group.  Killed itself, it takes the kernel along by the parent-death signal,
at which the kernel ends its children itself.  It is their subreaper, so none stays a zombie either.  Standard
library alone.

It also binds the lab to one CPU that no other lab has taken.  Kernel and guest process only ever hand over to
each other, so a second CPU adds nothing but wake-ups across CPUs (measured: a system call 15 instead of 52 us,
python start 0.12 instead of 0.32 s).  The claim is an abstract socket: it ends with the process.

Arguments: the kernel and its arguments.
"""

import contextlib
import ctypes
import os
import select
import signal
import socket
import struct
import sys

_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36
_SYS_SCHED_SETATTR = 314
SLICE_NS = 100_000


def claim_cpu() -> socket.socket | None:
    """Bind this process to a free CPU; the claim, or None where every CPU has a lab already."""
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    for cpu in sorted(os.sched_getaffinity(0), reverse=True):
        try:
            claim.bind(f"\0timberhand-vcan-lab-cpu{cpu}")
        except OSError:
            continue
        os.sched_setaffinity(0, {cpu})
        return claim
    return None


def hasten() -> None:
    """Go before everything ordinary on the CPU, for what runs inside may be hard-timed.

    Kernel and guest process hand over to each other thousands of times a second, and each time a busy neighbour keeps
    the CPU until the host's next tick.  Measured with one such neighbour per CPU, ticks of 5 ms inside: 161 of 5400
    missed as an ordinary process, 1 with a finer slice (any user, from Linux 6.12 on); as SCHED_FIFO the usual lateness
    is a third of that with the slice, but for a few stalls of 50 ms that the host reserves for others.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        attributes = struct.pack("IIQiIQQQ", 48, os.SCHED_OTHER, 0, 0, 0, SLICE_NS, 0, 0)
        ctypes.CDLL(None).syscall(_SYS_SCHED_SETATTR, 0, attributes, 0)


def main() -> None:
    claim = claim_cpu()  # noqa: F841  held until this process ends
    hasten()
    libc = ctypes.CDLL(None)
    libc.prctl(_PR_SET_CHILD_SUBREAPER, 1)
    keeper = os.getpid()
    kernel = os.fork()
    if kernel == 0:
        libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != keeper:
            os._exit(1)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.execv(sys.argv[1], sys.argv[1:])
    wait = select.poll()
    wait.register(0, select.POLLHUP)
    wait.register(os.pidfd_open(kernel), select.POLLIN)
    wait.poll()
    os.kill(kernel, signal.SIGKILL)  # not reaped yet, so its number is still its own
    with contextlib.suppress(ProcessLookupError):  # killed before it had a group
        os.killpg(kernel, signal.SIGKILL)
    with contextlib.suppress(ChildProcessError):
        while True:
            os.wait()


if __name__ == "__main__":
    main()
