"""The vcan lab: any command with real SocketCAN interfaces, on kernels that have none.

Three ways to the same result, chosen by ``choose.choose`` in this order:

- ``existing``: the interfaces asked for are there and up; the command uses them as they are.
- ``namespace``: the kernel has CAN and vcan; the interfaces are made in a network namespace of the lab's
  own, so two labs never meet and nothing is left behind.
- ``uml``: Debian's user-mode Linux kernel runs as an ordinary process on the host's file system, or, asked for, the
  lab's own (``lab_kernel``), in real or in simulated time.

Contract: the command's own exit status (128+N when signal N ended it), its stdout and stderr byte for byte
and apart, an empty stdin, signals forwarded; nothing of the lab outlives it, whoever is killed, and it writes
no file on the host but the compiled shim (``shim``).  Inside, ``TIMBERHAND_LAB`` is ``native`` or ``uml``.

Measured on Debian 12 with its 6.1 kernel, on a busy two-core virtual machine, and why it is built so:

- From start to running command 0.6 s.  Plainly started it is 2.1 s; 1.2 s without the kernel's RAID speed tests;
  the rest is gained by keeping kernel and guest processes on one CPU (``keeper``), which makes everything inside 2
  to 3 times faster: a system call 15 us, a page fault 80 us, starting python 0.12 s, importing numpy 0.4 s.
- 200 Hz over raw sockets, 10 frames a tick, four processes, FIFO: median wake-up 80 to 160 us late, 0 to 2 late
  cycles in 600, once 9 in 1000; the tails are the host's.  So the lab shows correctness and carries live runs, but
  no tick budget is ever read from it.
- Memory: the host gives only what is touched, 80 MB at rest, 110 MB with numpy and pybullet, 310 MB with torch;
  128 MB of guest memory carry numpy and pybullet.
- Files: the host sees what is written inside within a second, all of it at the end.  Unix sockets work on the
  host's file system, so no private /tmp is needed; the runtime directory is the guest's own nevertheless.
- Simulated time (the lab's own kernel) advances only when nothing can run.  Start, order and everything after come at
  the same simulated instants in every run: the guest holds time while it waits for the host, output never waits, and
  the clock on the wall begins at a fixed date.  An hour of sleep takes 0.2 s.
- Inside, an ordinary user gets FIFO and locked memory; candump, cansend and UDP on 127.0.0.1 work.

This package stays empty of imports: ``guest`` is loaded from it as the first process of a fresh kernel.
"""
