"""The record of one crane job, as an operator or the console writes it: what to pick, and where to put it."""

from __future__ import annotations

import msgspec

from machine.profile import Bunk


class Mission(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Pick one log, or what one grasp holds, and lay it down.

    ``log_id`` names the log (None: the one on top, then the one that is nearest by slewing); ``place_m`` is where its
    centre goes, base frame (None: where the target has most room).  Logs come from ``source`` (None: from everywhere
    outside the target) and go to ``target`` (None: the machine's bunk).  A pile on the ground is a `Bunk`, too: one
    whose floor is the ground and whose stakes are as high as it may get.  ``leave`` are the numbers of logs that are to
    stay where they are.
    """

    log_id: int | None = None
    place_m: tuple[float, float] | None = None
    source: Bunk | None = None
    target: Bunk | None = None
    leave: tuple[int, ...] = ()

    def to(self, bunk: Bunk) -> Bunk:
        """Where logs go on a machine with this bunk."""
        return self.target or bunk
