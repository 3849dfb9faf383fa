"""The activity manager as tables: states, events, what follows, how long each state may take and what is wrong then.

``PAPER_B`` is Fig. 8 of paper B (section 3.2.6): one log at a time, a first stop to look, a second one when the crane
foot has entered and left a circle round the log.  ``OURS`` drives to the best place for all logs in reach, takes them
one after the other with a new look before each, and brings the load to the landing.  Both share states and events, and
nothing but a table says what follows; what is not in it cannot happen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Final


class State(IntEnum):
    """What the forwarder is about."""

    IDLE = 0
    RAISE = 1
    SEARCH = 2
    HALT = 3
    LOOK = 4
    APPROACH = 5
    PASS = 6
    STOP = 7
    CHECK = 8
    LOWER = 9
    COLLECT = 10
    HAUL = 11
    SETTLE = 12
    UNLOAD = 13
    STOW = 14
    DONE = 15
    FAILED = 16


class Event(IntEnum):
    """What has come about; the order is the order in which they are asked for."""

    RESUMED = 0
    AUTO = 1
    AT_HEIGHT = 2
    LOG_NEAR = 3
    STANDING = 4
    AVERAGED = 5
    GONE = 6
    INSIDE = 7
    OUTSIDE = 8
    ARRIVED = 9
    VALID = 10
    INVALID = 11
    COLLECTED = 12
    MISSED = 13
    LOADED = 14
    EMPTY = 15
    STOWED = 16
    ROUND_END = 17
    ROUTE_END = 18
    TIME_OUT = 19


EVENTS: Final[Mapping[Event, str]] = {
    Event.RESUMED: "the switch is at Auto, and the mission was begun before the planner was started again",
    Event.AUTO: "the switch is at Auto",
    Event.AT_HEIGHT: "all four arms are at the wanted height",
    Event.LOG_NEAR: "a log is near enough to stop for",
    Event.STANDING: "the machine stands",
    Event.AVERAGED: "the log has been watched for the hold time",
    Event.GONE: "the log is not seen again",
    Event.INSIDE: "the crane foot has entered the circle round the log",
    Event.OUTSIDE: "the crane foot has left the circle",
    Event.ARRIVED: "the machine stands at the wanted place",
    Event.VALID: "a log lies where the crane can take it",
    Event.INVALID: "no log lies where the crane can take it",
    Event.COLLECTED: "the log lies in the bunk",
    Event.MISSED: "the grasp came up empty or was given up",
    Event.LOADED: "the bunk is full or holds all that is wanted, or the route has ended with logs on board",
    Event.EMPTY: "nothing is left in the bunk",
    Event.STOWED: "the crane rests over the bunk",
    Event.ROUND_END: "the last waypoint is reached, and logs that other landings take still lie along the route",
    Event.ROUTE_END: "the last waypoint is reached, or all logs that are wanted are taken",
    Event.TIME_OUT: "it takes too long",
}


class Height(IntEnum):
    """Where the swing arms are to be."""

    KEEP = 0
    TRANSPORT = 1
    LOADING = 2


@dataclass(frozen=True, slots=True)
class Rule:
    """A state: what it is in words, whether the carrier drives, where the frame is to be, whether the crane works, how
    long it may take [s], and what is wrong after that.  Driving time counts against the way, so a state that drives
    has the time that may pass without progress.
    """

    words: str
    patience_s: float
    trouble: str
    drives: bool = False
    height: Height = Height.KEEP
    crane: bool = False


RULES: Final[Mapping[State, Rule]] = {
    State.IDLE: Rule("waits for the switch to go to Auto", float("inf"), ""),
    State.RAISE: Rule("brings the frame to transport height", 30.0, "the swing arms did not reach the transport height",
                      height=Height.TRANSPORT),
    State.SEARCH: Rule("follows the waypoints and looks for logs", 20.0, "the machine does not get on along its way",
                       drives=True),
    State.HALT: Rule("stops before the log", 10.0, "the machine did not come to a stop"),
    State.LOOK: Rule("watches the log at standstill", 15.0, "the log was not seen well enough"),
    State.APPROACH: Rule("drives up to the log", 20.0, "the machine does not get on towards the log", drives=True),
    State.PASS: Rule("drives past the log", 20.0, "the machine does not get on past the log", drives=True),
    State.STOP: Rule("stops beside the log", 10.0, "the machine did not come to a stop"),
    State.CHECK: Rule("judges whether a log can be taken", 15.0, "no list of logs came"),
    State.LOWER: Rule("brings the frame to loading height", 30.0, "the swing arms did not reach the loading height",
                      height=Height.LOADING),
    State.COLLECT: Rule("takes a log into the bunk", 180.0, "the crane did not bring the log into the bunk",
                        crane=True),
    State.HAUL: Rule("drives the load to the landing", 20.0, "the machine does not get on towards the landing",
                     drives=True),
    State.SETTLE: Rule("brings the frame to loading height at the landing", 30.0,
                       "the swing arms did not reach the loading height", height=Height.LOADING),
    State.UNLOAD: Rule("unloads the bunk", 240.0, "the crane did not bring a log to the landing", crane=True),
    State.STOW: Rule("brings the crane over the bunk", 60.0, "the crane did not come to rest over the bunk",
                     crane=True),
    State.DONE: Rule("has finished", float("inf"), ""),
    State.FAILED: Rule("has given up", float("inf"), ""),
}  # fmt: skip

Table = Mapping[tuple[State, Event], State]

PAPER_B: Final[Table] = {
    (State.IDLE, Event.RESUMED): State.STOW,
    (State.IDLE, Event.AUTO): State.RAISE,
    (State.RAISE, Event.AT_HEIGHT): State.SEARCH,
    (State.SEARCH, Event.LOG_NEAR): State.HALT,
    (State.SEARCH, Event.ROUTE_END): State.DONE,
    (State.HALT, Event.STANDING): State.LOOK,
    (State.LOOK, Event.AVERAGED): State.APPROACH,
    (State.LOOK, Event.GONE): State.SEARCH,
    (State.LOOK, Event.TIME_OUT): State.SEARCH,
    (State.APPROACH, Event.INSIDE): State.PASS,
    (State.APPROACH, Event.ROUTE_END): State.STOP,
    (State.PASS, Event.OUTSIDE): State.STOP,
    (State.PASS, Event.ROUTE_END): State.STOP,
    (State.STOP, Event.STANDING): State.CHECK,
    (State.CHECK, Event.VALID): State.LOWER,
    (State.CHECK, Event.INVALID): State.SEARCH,
    (State.LOWER, Event.AT_HEIGHT): State.COLLECT,
    (State.COLLECT, Event.COLLECTED): State.STOW,
    (State.COLLECT, Event.MISSED): State.STOW,
    (State.STOW, Event.STOWED): State.RAISE,
}

OURS: Final[Table] = {
    (State.IDLE, Event.RESUMED): State.STOW,
    (State.IDLE, Event.AUTO): State.RAISE,
    (State.RAISE, Event.AT_HEIGHT): State.SEARCH,
    (State.SEARCH, Event.LOADED): State.HAUL,
    (State.SEARCH, Event.LOG_NEAR): State.APPROACH,
    (State.SEARCH, Event.ROUND_END): State.RAISE,
    (State.SEARCH, Event.ROUTE_END): State.DONE,
    (State.APPROACH, Event.ARRIVED): State.CHECK,
    (State.APPROACH, Event.GONE): State.SEARCH,
    (State.CHECK, Event.VALID): State.LOWER,
    (State.CHECK, Event.INVALID): State.STOW,
    (State.LOWER, Event.AT_HEIGHT): State.COLLECT,
    (State.COLLECT, Event.COLLECTED): State.CHECK,
    (State.COLLECT, Event.MISSED): State.CHECK,
    (State.HAUL, Event.ARRIVED): State.SETTLE,
    (State.SETTLE, Event.AT_HEIGHT): State.UNLOAD,
    (State.UNLOAD, Event.EMPTY): State.STOW,
    (State.STOW, Event.STOWED): State.RAISE,
}

WAYS: Final[Mapping[str, Table]] = {"ours": OURS, "paper-b": PAPER_B}
"""By the names that a person gives them."""
ENDS: Final = frozenset({State.DONE, State.FAILED})
"""Nothing follows, but that an operator begins anew."""


def awaited(table: Table, state: State) -> tuple[Event, ...]:
    """The events that a state reacts to, in the order in which they are asked for."""
    return tuple(sorted(event for known, event in table if known is state))


def following(table: Table, state: State, event: Event) -> State:
    """What follows; a state that runs out of time without a way on has failed.

    Raises:
        KeyError: this event does not concern this state.
    """
    if event is Event.TIME_OUT:
        return table.get((state, event), State.FAILED)
    return table[state, event]
