"""The transition tables of the activity manager: states, events, transitions, timeouts and their reasons.

``PAPER_B`` is Fig. 8 of paper B (section 3.2.6): one log at a time, a first stop to observe it, a second one when the
crane's base has entered and left a circle round it.  ``OURS`` drives to the best place for all logs in reach, loads
them one after the other with a new detection before each, and brings the load to the landing.  Both share states and
events.  Only a table decides what follows; a transition that is not in it cannot happen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Final


class State(IntEnum):
    """Current task of the forwarder."""

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
    """Reason for a transition; events are tested in this order."""

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
    IN_THE_WAY = 20


EVENT_DESCRIPTIONS: Final[Mapping[Event, str]] = {
    Event.RESUMED: "the mission is at Auto, and was begun before the planner restarted",
    Event.AUTO: "the mission is at Auto",
    Event.AT_HEIGHT: "all four swing arms are at the requested height",
    Event.LOG_NEAR: "a log is near enough to stop for",
    Event.STANDING: "the machine is at standstill",
    Event.AVERAGED: "the log has been observed for the hold time",
    Event.GONE: "the log is no longer detected",
    Event.INSIDE: "the crane's base has entered the circle round the log",
    Event.OUTSIDE: "the crane's base has left the circle",
    Event.ARRIVED: "the machine stands at the requested place",
    Event.VALID: "the crane can grasp a log from here",
    Event.INVALID: "the crane can grasp no log from here",
    Event.COLLECTED: "the log lies in the bunk",
    Event.MISSED: "the grasp failed or was given up",
    Event.LOADED: "the bunk is full or holds all wanted logs, or the route has ended with logs on board",
    Event.EMPTY: "the bunk is empty",
    Event.STOWED: "the crane is stowed over the bunk",
    Event.ROUND_END: "the last waypoint is reached, and logs of other landings still lie along the route",
    Event.ROUTE_END: "the last waypoint is reached, or all wanted logs are loaded",
    Event.TIME_OUT: "the state has timed out",
    Event.IN_THE_WAY: "a log that the crane can load lies in the way of a wheel",
}


class Height(IntEnum):
    """Requested height of the swing arms."""

    KEEP = 0
    TRANSPORT = 1
    LOADING = 2


@dataclass(frozen=True, slots=True)
class Rule:
    """Properties of a state: description, timeout [s] and its reason, whether the carrier drives, frame height, whether
    the crane works.  The timeout of a driving state counts from the last progress.
    """

    description: str
    timeout_s: float
    timeout_reason: str
    drives: bool = False
    height: Height = Height.KEEP
    crane: bool = False


RULES: Final[Mapping[State, Rule]] = {
    State.IDLE: Rule("waits to be set to Auto", float("inf"), ""),
    State.RAISE: Rule(
        "moves the frame to transport height",
        30.0,
        "the swing arms did not reach the transport height",
        height=Height.TRANSPORT,
    ),
    State.SEARCH: Rule(
        "follows the waypoints and looks for logs", 20.0, "the machine makes no progress on the route", drives=True
    ),
    State.HALT: Rule("stops before the log", 10.0, "the machine did not come to a stop"),
    State.LOOK: Rule("observes the log at standstill", 15.0, "the log was not observed often enough"),
    State.APPROACH: Rule("drives up to the log", 20.0, "the machine makes no progress towards the log", drives=True),
    State.PASS: Rule("drives past the log", 20.0, "the machine makes no progress past the log", drives=True),
    State.STOP: Rule("stops beside the log", 10.0, "the machine did not come to a stop"),
    State.CHECK: Rule("checks whether a log can be grasped", 15.0, "no log list was received"),
    State.LOWER: Rule(
        "moves the frame to loading height",
        30.0,
        "the swing arms did not reach the loading height",
        height=Height.LOADING,
    ),
    State.COLLECT: Rule(
        "loads a log into the bunk", 180.0, "the crane did not bring the log into the bunk", crane=True
    ),
    State.HAUL: Rule(
        "drives the load to the landing", 20.0, "the machine makes no progress towards the landing", drives=True
    ),
    State.SETTLE: Rule(
        "moves the frame to loading height at the landing",
        30.0,
        "the swing arms did not reach the loading height",
        height=Height.LOADING,
    ),
    State.UNLOAD: Rule("unloads the bunk", 240.0, "the crane did not bring a log to the landing", crane=True),
    State.STOW: Rule(
        "moves the crane over the bunk", 60.0, "the crane did not reach its stow position over the bunk", crane=True
    ),
    State.DONE: Rule("has finished", float("inf"), ""),
    State.FAILED: Rule("has failed", float("inf"), ""),
}

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
    (State.SEARCH, Event.IN_THE_WAY): State.STOP,
    (State.APPROACH, Event.IN_THE_WAY): State.STOP,
    (State.STOP, Event.STANDING): State.CHECK,
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

TABLES: Final[Mapping[str, Table]] = {"ours": OURS, "paper-b": PAPER_B}
"""By their names on the command line."""
FINAL_STATES: Final = frozenset({State.DONE, State.FAILED})
"""Final states."""


def awaited_events(table: Table, state: State) -> tuple[Event, ...]:
    """List the events that a state reacts to, in the order in which they are tested."""
    return tuple(sorted(event for known, event in table if known is state))


def next_state(table: Table, state: State, event: Event) -> State:
    """Return the next state; a timeout without a transition leads to FAILED.

    Raises:
        KeyError: the state does not react to this event.
    """
    if event is Event.TIME_OUT:
        return table.get((state, event), State.FAILED)
    return table[state, event]
