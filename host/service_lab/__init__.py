"""The service lab: tests of the installed services under a real systemd, including their failures.

``python -m host.service_lab`` boots the vcan lab's user-mode Linux kernel with systemd as its first process on a
temporary overlay of this computer's files, installs a wheel as a user would, and starts the services on vcan interfaces
with the emulated plant.  In one guest, with the crane moving, it kills, hangs and stops the controller, kills and hangs
the guard, and removes the bus; the camera's service sees a log in pictures of a second plant that stands still, is
killed and hung, and loses its camera.  In another the services load a log.  Everything in the guest runs from the
wheel; the checkout is hidden from it.  The guest writes to its own memory only, never to the host.

- ``host``: builds the wheel, boots the guest, reads its messages.  ``init.sh``: from the kernel to systemd.
- ``updates``: an update that is refused, one that stays, one that is cut off and comes back.
- ``guest``: the steps inside, as a service of that systemd.  ``pilot``: arms and moves the machine, observes the bus.
  ``trial``: ends the controller or the guard, or takes the bus away, and measures the reaction.
  ``perception``: the camera's service and its failures.  ``authority``: who may command, and a log into the bunk.

Time is simulated: it passes only while every process of the guest sleeps.  So no verdict depends on how busy this
computer is, and what computing costs is not seen.
"""
