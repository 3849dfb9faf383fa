"""The real-time lab boots Debian's PREEMPT_RT kernel in qemu and runs the control loop in it, without root.

``package`` finds the kernel, ``files`` makes the initial file system (this Python, this checkout, what they import),
``host`` boots it and checks the result, ``guest`` is the first process inside.  In the guest: real SocketCAN on vcan,
controller and guard as their units start them (Type=notify, FIFO, locked memory), and cyclictest.

Contract: a functional check.  Emulated, the guest's clock counts instructions (one a nanosecond) and skips idle time,
so a slow or busy host delays nothing inside, and no figure of time is evidence of latency.
"""
