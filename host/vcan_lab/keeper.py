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
import time

_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36
_SYS_SCHED_SETATTR = 314
NICENESS = -15
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


def hasten(kernel: int) -> None:
    """Give the kernel's session a large and finely cut share of the CPU, for what runs inside may be hard-timed.

    A session competes as one group (sched(7), autogroup), whatever the niceness of its processes.  Kernel and guest
    process hand over to each other thousands of times a second; with a neighbour busy on the CPU an ordinary share cost
    161 of 5400 ticks of 5 ms.  Real-time priority is no way out: the host then stops everything for 50 ms at a time.
    Only root may ask for a larger share; a kernel before 6.12 ignores the slice.
    """
    attributes = struct.pack("IIQiIQQQ", 48, os.SCHED_OTHER, 0, 0, 0, SLICE_NS, 0, 0)
    ctypes.CDLL(None).syscall(_SYS_SCHED_SETATTR, kernel, attributes, 0)
    for _ in range(200):
        if os.getsid(kernel) == kernel:  # it makes its session soon after its start
            break
        time.sleep(0.01)
    with contextlib.suppress(OSError), open(f"/proc/{kernel}/autogroup", "w") as share:
        share.write(str(NICENESS))


def main() -> None:
    claim = claim_cpu()  # noqa: F841  held until this process ends
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
    hasten(kernel)
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
