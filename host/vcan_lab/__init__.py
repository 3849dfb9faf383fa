"""The vcan lab runs any command with real SocketCAN interfaces, also on kernels without CAN.

Three methods give the same result; ``choose.choose`` takes the first one that works:

- ``existing``: the requested interfaces exist and are up; the command uses them.
- ``namespace``: the kernel has CAN and vcan; the interfaces are created in a private network namespace, so labs are
  independent of each other and nothing remains afterwards.
- ``uml``: a user-mode Linux kernel runs as an ordinary process on the host's file system: Debian's, or on request the
  lab's own (``lab_kernel``), in real or in simulated time.

Contract: the exit status of the command (128+N when signal N ended it), separate stdout and stderr byte for byte, an
empty stdin, signals forwarded.  No process of the lab outlives it, whichever process is killed, and the lab writes no
file on the host except the compiled shim (``shim``).  Inside, ``TIMBERHAND_LAB`` is ``native`` or ``uml``.

Measured on Debian 12 with its 6.1 kernel, on a busy two-core virtual machine, with the reasons for this design:

- 0.6 s from start to the running command.  A plain start takes 2.1 s, 1.2 s without the kernel's RAID speed tests;
  keeping kernel and guest processes on one CPU (``keeper``) gains the rest and makes everything inside 2 to 3 times
  faster: a system call 15 us, a page fault 80 us, starting python 0.12 s, importing numpy 0.4 s.
- 200 Hz over raw sockets, 10 frames per tick, four processes, FIFO: median wake-up 80 to 160 us late, 0 to 2 late
  cycles in 600, once 9 in 1000; the host causes the tails.  The lab shows correctness and carries live runs; tick
  budgets cannot be measured in it.
- Memory: the host provides only touched pages: 80 MB at rest, 110 MB with numpy and pybullet, 310 MB with torch.
  128 MB of guest memory suffice for numpy and pybullet.
- Files: the host sees written data within a second, and all of it at the end.  Unix sockets work on the host's file
  system, so no private /tmp is necessary; the runtime directory is private nevertheless.
- Simulated time (the lab's own kernel) advances only when nothing can run.  Every run has the same simulated times: the
  guest holds time while it waits for the host, output never waits, and the wall clock starts at a fixed date.  An hour
  of sleep takes 0.2 s.
- Inside, an ordinary user gets FIFO and locked memory; candump, cansend and UDP on 127.0.0.1 work.

This package must not import anything: ``guest`` is loaded from it as the first process of a fresh kernel.
"""
