"""A small model of controller, guard, valve node and emergency stop, to be searched exhaustively.

The controller's modes change by the real table (`controller.transitions`); which reaction leads to which event, and
which broken rules latch the guard, come from the real code as well.  Guard and valve node are written down here as the
rules that their documentation states; `test_mode_model` holds them against the real guard and the real node.

Time is one event: everything that only needs time has happened after it (a ramp is over, the guard is calm).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum, auto

from controller.transitions import OPERATING, TRANSITIONS, Event
from machine.status.modes import Mode


class Link(Enum):
    """The link of an operator who watches."""

    OFF = auto()
    WATCHED = auto()
    LOST = auto()


class Broken(Enum):
    """What is wrong for the guard now."""

    NOTHING = auto()
    SILENCE = auto()
    """A frame is missing: nothing was heard that must not be."""
    HEARD = auto()
    """A rule that latches is broken."""


@dataclass(frozen=True, slots=True)
class State:
    """Everything that matters, and what has happened since the last stop.

    ``ramping``: a stop's ramp is not over; ``latching``: FAULT follows it.  ``cause`` is the event of a fault that the
    controller sees while it is armed.  ``calm``: the commands were neutral long enough.  ``locked``: the valve node
    lost a condition while it was active.  ``armed`` and ``reset_pressed`` tell whether a person has armed since the
    last stop, and pressed the button since the guard last latched.
    """

    mode: Mode = Mode.BOOT
    ramping: bool = False
    latching: bool = False
    cause: Event | None = None
    pressed: bool = False
    pilot_on: bool = True
    broken: Broken = Broken.NOTHING
    latched: bool = False
    calm: bool = False
    locked: bool = False
    armed: bool = False
    reset_pressed: bool = True
    link: Link = Link.OFF

    @property
    def armed_key(self) -> bool:
        """Whether the commands carry the arm key."""
        return self.mode in OPERATING or self.ramping

    @property
    def moving_commands(self) -> bool:
        """Whether commands other than neutral can go out."""
        return self.mode is Mode.ACTIVE or self.ramping

    @property
    def enabled(self) -> bool:
        """The guard's enable."""
        return self.broken is Broken.NOTHING and not self.pressed and not self.latched and self.calm

    @property
    def node_active(self) -> bool:
        """Whether the valve node follows commands."""
        return self.pilot_on and self.enabled and self.armed_key and not self.locked

    @property
    def may_move(self) -> bool:
        """Whether a spool can be open."""
        return self.node_active and self.moving_commands


def applied(state: State, event: Event) -> State:
    """The controller's mode after an event, with its ramp."""
    after = TRANSITIONS.get((state.mode, event), state.mode)
    if after is state.mode or (state.latching and event is Event.RAMP):
        return state
    stops = state.mode is Mode.ACTIVE and after is Mode.STOP
    armed = event is Event.ARM or (state.armed and after in OPERATING)
    return replace(state, mode=after, ramping=stops, latching=stops and event is Event.RAMP, armed=armed)


def settled(state: State) -> State:
    """What follows at once: the guard judges, the controller reacts, the node judges."""
    was_active = state.node_active
    if state.pressed:
        state = replace(state, pilot_on=False)
    if state.broken is Broken.HEARD or state.pressed:
        state = replace(state, latched=True, calm=False, reset_pressed=False)
    elif state.broken is Broken.SILENCE:
        state = replace(state, calm=False)
    if state.pressed:
        state = applied(state, Event.CUT)
    elif state.armed_key and not state.enabled:
        state = applied(state, Event.CUT)  # the controller sees that the guard refuses, or is gone
    elif state.armed_key and state.cause is not None:
        state = applied(state, state.cause)
    elif state.armed_key and state.link is Link.LOST:
        state = applied(state, Event.HOLD)
    if was_active and not (state.pilot_on and state.enabled):
        state = replace(state, locked=True)
    if not state.armed_key:
        state = replace(state, locked=False)  # a fresh frame without the key
    return state


def time_passes(state: State) -> State:
    """A second: ramps are over, start-up is complete, the guard is calm if it may be."""
    if state.ramping:
        latching = state.latching
        state = replace(state, ramping=False)
        if latching:
            state = applied(state, Event.LATCHED)
        state = replace(state, latching=False)
    if state.mode is Mode.BOOT:
        state = applied(state, Event.BOOTED)
    if state.broken is Broken.NOTHING and not state.pressed and not state.moving_commands:
        state = replace(state, calm=True)
    return state


def arm(state: State) -> State:
    """The operator's ARM, refused unless the machine is ready."""
    ready = not state.ramping and not state.pressed and state.cause is None and state.enabled and state.pilot_on
    ready = ready and state.link is not Link.LOST
    return applied(state, Event.ARM) if ready and state.mode is not Mode.FAULT else state


def press_reset(state: State) -> State:
    """The button on the safety module: pilot supply, guard and controller each take its edge."""
    if not state.pressed:
        state = replace(state, pilot_on=True)
        if state.broken is Broken.NOTHING and not state.moving_commands:
            state = replace(state, latched=False, reset_pressed=True)
    return reset(state)


def reset(state: State) -> State:
    """The operator's RESET."""
    return state if state.ramping else applied(state, Event.RESET)


def disarm(state: State) -> State:
    """The operator's DISARM."""
    return state if state.ramping else applied(state, Event.DISARM)


PERSON: dict[str, Callable[[State], State]] = {
    "ARM": arm,
    "RESET": reset,
    "reset button": press_reset,
    "release": lambda s: replace(s, pressed=False),
    "WATCH": lambda s: replace(s, link=Link.WATCHED),
    "WATCH_END": lambda s: replace(s, link=Link.OFF),
}
"""What a person does to start."""
STOPS: dict[str, Callable[[State], State]] = {
    "STOP": lambda s: applied(s, Event.HOLD),
    "DISARM": disarm,
    "emergency stop": lambda s: replace(s, pressed=True),
}
MACHINE: dict[str, Callable[[State], State]] = {
    "time": time_passes,
    "setpoint": lambda s: applied(s, Event.SETPOINT) if s.mode in OPERATING else s,
    "done": lambda s: applied(s, Event.DONE) if s.mode is Mode.ACTIVE else s,
    "link lost": lambda s: replace(s, link=Link.LOST) if s.link is Link.WATCHED else s,
    "cause gone": lambda s: replace(s, cause=None),
    "rules hold": lambda s: replace(s, broken=Broken.NOTHING),
    "silence": lambda s: replace(s, broken=Broken.SILENCE),
    "rule broken": lambda s: replace(s, broken=Broken.HEARD),
    **{
        f"cause {event.name}": (lambda s, event=event: replace(s, cause=event))
        for event in (Event.HOLD, Event.RAMP, Event.CUT)
    },
}
EVENTS = PERSON | STOPS | MACHINE


def after(state: State, name: str) -> State:
    """The state after an event and what follows from it at once."""
    return settled(EVENTS[name](state))


def reachable(start: State | None = None) -> dict[State, tuple[State, str] | None]:
    """Every state that can be reached, with the state and event that led there first (breadth first)."""
    first = settled(start or State())
    found: dict[State, tuple[State, str] | None] = {first: None}
    waiting = [first]
    for state in waiting:
        for name in EVENTS:
            other = after(state, name)
            if other not in found:
                found[other] = (state, name)
                waiting.append(other)
    return found


def way(found: dict[State, tuple[State, str] | None], state: State) -> list[str]:
    """The events that lead to a state, for a message."""
    names: list[str] = []
    step = found[state]
    while step is not None:
        state, name = step
        names.append(name)
        step = found[state]
    return names[::-1]


def transitions(found: dict[State, tuple[State, str] | None]) -> Iterator[tuple[State, str, State]]:
    """Every step between reachable states."""
    for state in found:
        for name in EVENTS:
            yield state, name, after(state, name)
