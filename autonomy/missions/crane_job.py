"""The record of one crane job, written by an operator or the console: what to pick and where to place it."""

from __future__ import annotations

import msgspec

from machine.profile import Bunk


class CraneJob(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Pick one log, or all logs that one grasp holds, and place them.

    ``log_id`` selects the log (None: the topmost, then the nearest by slewing); ``place_m`` is the target position of
    its centre in the base frame (None: where the target has most room).  Logs come from ``source`` (None: anywhere
    outside the target) and go to ``target`` (None: the machine's bunk).  A pile on the ground is a `Bunk`, too: its
    floor is the ground, and its stakes are as high as it may get.  ``leave`` lists logs that must not be picked.
    ``untried``: the grasp that was selected last was not tried, so that nothing follows from what still lies there.
    """

    log_id: int | None = None
    place_m: tuple[float, float] | None = None
    source: Bunk | None = None
    target: Bunk | None = None
    leave: tuple[int, ...] = ()
    untried: bool = False

    def to(self, bunk: Bunk) -> Bunk:
        """Return the target on a machine with this bunk."""
        return self.target or bunk
