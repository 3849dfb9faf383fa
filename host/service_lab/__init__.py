"""The service lab: the installed services under a real systemd, and what happens when one of them dies.

``python -m host.service_lab`` boots Debian's user-mode Linux kernel with systemd as its first process on a throw-away
overlay of this machine's own files, installs a wheel as a user would, starts the services on vcan interfaces beside the
emulated plant, and then, with the crane moving, kills, hangs and stops the controller, kills and hangs the guard, and
takes the bus away.  Whatever runs in the guest comes out of the wheel; the checkout is hidden from it.  Nothing reaches
the host: what the guest writes lies in its own memory.

- ``host``: builds the wheel, boots, reads what the guest says.  ``init.sh``: the guest's way to systemd.
- ``guest``: the steps inside, as a service of that systemd.  ``pilot``: arms, moves and watches the bus.
  ``trial``: one way to end controller or guard, and what the valves did.  ``lost_bus``: the bus goes and comes back.

Times are the guest's.  A window in which the whole guest stood still is marked: such a trial is repeated, and when
every repetition was disturbed the figure is "inconclusive" instead of bad.
"""
