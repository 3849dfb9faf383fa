"""The update as data: its steps in order, and pure decisions about them.

Power may fail before, in or after every step.  Up to `Step.SWITCH` the old release is in use, from then on the new
one; there is nothing in between, because `Step.SWITCH` is one rename.  From `Step.TRY` to `Step.ACCEPT` the disk says
where to return to, and the next start of the computer judges the release (`after_interruption`).
"""

from __future__ import annotations

from enum import StrEnum
from typing import Final

from host.release.trees import State


class Step(StrEnum):
    """One step; the words are what the command prints."""

    DISARMED = "the machine is disarmed"
    CLEAR = "remove what an interrupted update left"
    UNPACK = "unpack the bundle"
    VERIFY = "check its signature and every file"
    BUILD = "install its packages into a tree of their own"
    SEAL = "mark the tree as whole"
    CHECK = "the new release accepts the settings"
    LINKS = "lay out what is new outside the tree"
    TRY = "note where to return to"
    STOP = "stop the services"
    SWITCH = "change to the other release"
    RELOAD = "let systemd read the units"
    START = "start controller and guard"
    GATE = "wait for READY, STANDBY and GOOD"
    START_OTHERS = "start the other services"
    ACCEPT = "keep it"
    PRUNE = "remove releases before the last two"
    RETURN = "change back"
    END_TRIAL = "end the trial"


_CHANGE: Final = (
    Step.DISARMED, Step.TRY, Step.STOP, Step.SWITCH, Step.RELOAD, Step.START, Step.GATE, Step.START_OTHERS, Step.ACCEPT,
    Step.PRUNE,
)  # fmt: skip
_PREPARE: Final = (Step.CHECK, Step.LINKS)
UPDATE: Final = (
    Step.DISARMED, Step.CLEAR, Step.UNPACK, Step.VERIFY, Step.BUILD, Step.SEAL, *_PREPARE, *_CHANGE,
)  # fmt: skip
"""To a bundle's release."""
ROLLBACK: Final = (*_PREPARE, *_CHANGE)
"""To a release that is here already."""
BACK: Final = (Step.STOP, Step.RETURN, Step.RELOAD, Step.END_TRIAL, Step.START, Step.START_OTHERS)
"""Back to the release before, when the new one did not pass."""


def after_interruption(state: State) -> tuple[Step, ...]:
    """What is left to do after a power cut, from what the links say."""
    if state.trial is None:
        return (Step.CLEAR,)
    if state.trial == state.current:
        return (Step.END_TRIAL, Step.CLEAR)
    return (Step.GATE, Step.START_OTHERS, Step.ACCEPT, Step.PRUNE)


def needs_return(state: State) -> bool:
    """Whether a failure now has changed the release in use, so that it must be changed back."""
    return state.trial is not None and state.trial != state.current
