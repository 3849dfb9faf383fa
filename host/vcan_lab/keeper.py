"""Parent of the user-mode kernel: when the kernel or the wrapper ends, all processes of the kernel end.

The kernel has many child processes in its own session, which outlive it when it is killed; the wrapper may be killed,
too.  This process waits for either (its standard input is a pipe that only the wrapper holds open) and then kills the
kernel's process group.  If this process is killed, the kernel gets the parent-death signal and ends its children.  It
is their subreaper, so that no zombie remains.  Standard library alone.

It also binds the lab to one CPU that no other lab uses.  Kernel and guest process alternate, so a second CPU adds only
wake-ups across CPUs (measured: a system call takes 15 instead of 52 us, a start of python 0.12 instead of 0.32 s).  The
claim is an abstract socket, which disappears with the process.

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
    """Bind this process to a free CPU; return the claim, or None when every CPU has a lab."""
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    for cpu in sorted(os.sched_getaffinity(0), reverse=True):
        try:
            claim.bind(f"\0timberhand-vcan-lab-cpu{cpu}")
        except OSError:
            continue
        os.sched_setaffinity(0, {cpu})
        return claim
    return None


def prioritize(kernel: int) -> None:
    """Give the kernel's session a large share of the CPU in short slices, because loops inside may be real-time.

    A session competes as one group (sched(7), autogroup), regardless of the niceness of its processes.  Kernel and
    guest process alternate thousands of times per second; with another busy process on the CPU an ordinary share cost
    161 of 5400 ticks of 5 ms.  Real-time priority does not help: the host then stops everything for 50 ms at a time.
    Only root may raise the share; kernels before 6.12 ignore the slice.
    """
    attributes = struct.pack("IIQiIQQQ", 48, os.SCHED_OTHER, 0, 0, 0, SLICE_NS, 0, 0)
    ctypes.CDLL(None).syscall(_SYS_SCHED_SETATTR, kernel, attributes, 0)
    for _ in range(200):
        if os.getsid(kernel) == kernel:  # it creates its session soon after its start
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
    prioritize(kernel)
    wait = select.poll()
    wait.register(0, select.POLLHUP)
    wait.register(os.pidfd_open(kernel), select.POLLIN)
    wait.poll()
    os.kill(kernel, signal.SIGKILL)  # not reaped yet, so its process id is not reused
    with contextlib.suppress(ProcessLookupError):  # killed before it had a process group
        os.killpg(kernel, signal.SIGKILL)
    with contextlib.suppress(ChildProcessError):
        while True:
            os.wait()


if __name__ == "__main__":
    main()
