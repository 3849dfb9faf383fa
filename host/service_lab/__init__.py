"""The service lab: tests of the installed services under a real systemd, including their failures.

``python -m host.service_lab`` boots Debian's user-mode Linux kernel with systemd as its first process on a temporary
overlay of this computer's files, installs a wheel as a user would, starts the services on vcan interfaces with the
emulated plant, and then, with the crane moving, kills, hangs and stops the controller, kills and hangs the guard, and
removes the bus.  The camera's service sees a log in pictures of a second plant that stands still, is killed and hung,
and loses its camera.  Everything in the guest runs from the wheel; the checkout is hidden from it.  The guest writes to
its own memory only, never to the host.

- ``host``: builds the wheel, boots the guest, reads its messages.  ``init.sh``: from the kernel to systemd.
- ``updates``: an update that is refused, one that stays, one that is cut off and comes back.
- ``guest``: the steps inside, as a service of that systemd.  ``pilot``: arms and moves the machine, observes the bus.
  ``trial``: ends the controller or the guard and measures the reaction.  ``lost_bus``: removes and restores the bus.
  ``perception``: the camera's service and its failures.

Times are those of the guest.  A trial during which the whole guest stood still is repeated; if every repetition was
disturbed, the figure is "inconclusive" instead of failed.
"""
