"""The guard's checks: pure ``step(now_ns, frames) -> frames``, no allocation that lasts.

It watches the commands on both buses, whoever sends them, and everything that they depend on, by its own rules and its
own decoding.  A frame with an 11-bit identifier belongs to crane0, one with 29 bits to mach0.  GuardStat goes out every
10 ms and GuardAlive every 20 ms, and at once when the verdict changes; ``Enable`` is 0xA only while no rule is broken.
It returns when the rules hold and the commands have been neutral for 200 ms.  A broken rule of `LATCHING` needs a
person before that: the reset button of the safety module, pressed after the cause is gone, and nothing else.  Until
then, and while the commands are silent, GuardPilot switches the pilot supply off.  Neutral commands are always allowed.
The guard never commands: silent or dead, it stops the machine by absence.

When several rules are broken, the verdict is the first of: what a frame violates (one of `LATCHING` first), the
emergency stop, motion that nobody commands, missing commands, the carrier, and the rules on a commanded crane.
"""

from __future__ import annotations

from typing import Final

from can_dbc.frame import EXTENDED, Frame, RawFrame
from controller.guard import carrier as mach0
from controller.guard.envelope import Envelope
from controller.guard.joints import CommandedAxis, MeasuredJoint, MotionWatch
from controller.guard.layout import GuardConfigError, Layout
from controller.guard.reach import Reach
from controller.guard.stream import FrameEffect, Punctuality, SentMessage, WatchedMessage
from controller.guard.verdicts import AUX_AXIS, DRIVE_AXIS, FINE, GRAPPLE_AXIS, LATCHING, NO_AXIS, Finding, Verdict

GUARD_NODE: Final = 0x7D
HEARTBEAT_KEY: Final = 0x700 + GUARD_NODE
ENABLE, SUPPLY, ARM_KEY = 0xA, 0xA, 0xA
STATUS_NS: Final = 10_000_000
ALIVE_NS: Final = 20_000_000
HEARTBEAT_NS: Final = 100_000_000
CALM_NS: Final = 200_000_000
SILENCE_NS: Final = 300_000_000
"""The pilot supply goes off when commands have been missing for this long."""
PERSON_NS: Final = 300_000_000
PERSON_CARRIER_NS: Final = 2_200_000_000
"""A person in the zone: the controller stops the crane in 150 ms, and the carrier with a ramp of 1 m/s^2."""
AGREE_NS: Final = 200_000_000
"""A controller that says that it has stopped ramps the spools to neutral in 150 ms."""
STOP_NS, RAMP_NS = 85_000_000, 200_000_000
"""After a person's STOP the spools ramp to neutral in 150 ms: so long they may be as open as at the STOP, and after it
only by `STOP_SHARE` of that, or shut but for `STOP_PCT`; then they are neutral."""
STOP_SHARE, STOP_PCT = 0.75, 5.0
HELD_PCT: Final = 30.0
"""Past the dead-band; an opening below this holds a joint in place while the carrier drives."""
APART_PERIODS: Final = 3
"""ValveCmdA and B come together; when one of them stays away for longer than this, it is lost: the valve node itself
waits for 50 ms, and its ramp takes 60 ms more."""
RANGE_MARGIN_UNITS: Final = 0.008
"""How far outside its range [rad, m] a joint may still be driven outward."""
BEYOND_STEPS: Final = 2
"""Steps in a row in which the crane must be where it must not: one sample that jumps is an encoder's fault."""
GRAPPLE_DEADBAND_PCT: Final = 10.0
GRAPPLE_CLOSING_NS: Final = 250_000_000
PRESSED_NS: Final = 1_200_000_000
"""A joint comes to rest on its oil within this time after jaws have moved, half of its slowest period."""
_NEUTRAL, _SPOOL = 0, 2
_GRAPPLE_OPENS, _GRAPPLE_CLOSES = 1, 2
_GRAPPLE_SIDE: Final = (0.0, 1.0, -1.0, -1.0)
"""Side of the grapple's spool by GrappleMode: neutral, opens, closes, holds."""
_RELEASED, _PRESSED = 1, 1
_PERSON = (1, 2)  # yes, and faulty: a detector that has failed sees nobody
_ARM, _ENDS = 1, (2, 3)
"""A person's ARM; DISARM and STOP.  RESET ends nothing: a machine that works goes on."""
_COMMANDS: Final = ("ValveCmdA", "ValveCmdB")
_OPERATING: Final = (2, 3)
"""CtrlStatus.Mode: armed, run."""
MESSAGES: Final = (*_COMMANDS, "EstopStat", "CtrlStatus", "ValveFbA", "ValveFbB", "GuardStat", "GuardPilot")


class Guard:
    """All state of the guard; `step` is its whole behaviour.  ``latched``: a person has not pressed reset yet."""

    __slots__ = (
        "_a", "_agreed_ns", "_apart_ns", "_armed", "_b", "_beyond", "_calm_ns", "_carrier", "_clear_ns", "_commands",
        "_commands_of", "_estop", "_feedback", "_grapple_field", "_heard_ns", "_heartbeat_ns", "_jaws_ns", "_now_ns",
        "_open_pct", "_operated_ns", "_own_keys", "_punctuality", "_reach", "_reset_seen", "_sent", "_status",
        "_stopped_ns", "_supply", "_watches", "axis", "events", "joints", "latched", "motion", "profile_check",
        "verdict",
    )  # fmt: skip

    def __init__(self, envelope: Envelope, layouts: dict[str, Layout], latched: bool = False) -> None:
        axes = envelope.axes
        self._a, self._b = (WatchedMessage(layouts[n], Verdict.STALE, Verdict.CORRUPT) for n in MESSAGES[:2])
        self._estop = WatchedMessage(layouts["EstopStat"], Verdict.ESTOP_LOST, Verdict.ESTOP_LOST)
        self._status, *self._feedback = (WatchedMessage(layouts[name]) for name in MESSAGES[3:6])
        self._carrier = mach0.Carrier(envelope.carrier, layouts) if envelope.carrier else None
        watched = [self._a, self._b, self._estop, self._status, *self._feedback]
        sent = [("GuardStat", STATUS_NS), ("GuardPilot", STATUS_NS)]
        self._punctuality = {watch: Punctuality(envelope.period_ns) for watch in watched[:2]}
        if self._carrier is not None:
            watched += [*self._carrier.commands, self._carrier.state]
            sent.append(("GuardAlive", ALIVE_NS))
            self._punctuality |= {watch: Punctuality(mach0.COMMAND_NS) for watch in self._carrier.commands}
        self._watches = {watch.layout.key: watch for watch in watched}
        self._sent = [SentMessage(layouts[name], period_ns) for name, period_ns in sent]
        self._own_keys = (*(message.layout.key for message in self._sent), HEARTBEAT_KEY)
        sensed = {axis.number: MeasuredJoint(axis, layouts[axis.message]) for axis in axes if axis.message}
        self.joints = {joint.layout.key: joint for joint in sensed.values()}
        fields_a, fields_b = layouts["ValveCmdA"].fields, layouts["ValveCmdB"].fields
        missing = [axis.signal for axis in axes if axis.signal not in fields_a and axis.signal not in fields_b]
        if missing:
            raise GuardConfigError("guard.no-command-signal", f"crane.dbc: no valve command is called {missing[0]}.")
        self._commands = [CommandedAxis(axis, (fields_a | fields_b)[axis.signal]) for axis in axes]
        carried = ((self._a, fields_a), (self._b, fields_b))
        self._commands_of = {watch: [c for c in self._commands if c.axis.signal in fields] for watch, fields in carried}
        self.motion: list[tuple[WatchedMessage, MotionWatch]] = []
        spools = [(axis.number, axis.signal, min(axis.deadbands_pct), axis.closing_ns) for axis in axes]
        spools.append((GRAPPLE_AXIS, "Grapple", GRAPPLE_DEADBAND_PCT, GRAPPLE_CLOSING_NS))
        for number, signal, deadband_pct, closing_ns in spools:
            feedback = next(m for m in self._feedback if f"Spool{signal}" in m.layout.fields)
            field = feedback.layout.fields[f"Spool{signal}"]
            self.motion.append((feedback, MotionWatch(number, field, deadband_pct, closing_ns, sensed.get(number))))
        self._reach, self.profile_check = Reach(envelope), envelope.profile_check
        self._grapple_field = fields_b["Grapple"]
        self.verdict, self.axis = Verdict.NO_COMMAND, NO_AXIS
        self.events = 0
        self._supply, self._beyond = False, 0
        self._now_ns = self._calm_ns = self._heartbeat_ns = self._clear_ns = self._agreed_ns = 0
        self._heard_ns, self._jaws_ns = -SILENCE_NS - 1, -PRESSED_NS - 1
        self._apart_ns = APART_PERIODS * envelope.period_ns
        self._armed, self._operated_ns, self._open_pct, self._stopped_ns = False, 0, 0.0, -PERSON_CARRIER_NS
        self.latched, self._reset_seen = latched, True  # a button that is down already is no edge

    def step(self, now_ns: int, frames: list[Frame]) -> list[RawFrame]:
        """Check the frames since the last call (any period up to 10 ms); returns the frames to send."""
        elapsed_s, self._now_ns = min(now_ns - self._now_ns, STATUS_NS) * 1e-9, now_ns
        (verdict, axis), pressed = FINE, False
        for frame in frames:
            found, where = self._receive(frame, now_ns)
            if verdict is Verdict.GOOD or (found in LATCHING and verdict not in LATCHING):
                verdict, axis = found, where
            pressed = self._reset_pressed() or pressed
        state = self._check_state(now_ns, elapsed_s)
        if verdict is Verdict.GOOD or (state[0] in LATCHING and verdict not in LATCHING):
            verdict, axis = state
        changed = self._settle(verdict, axis, pressed, now_ns)
        values = {
            "Enable": ENABLE if self.enabled else 0, "Supply": SUPPLY if self._supply else 0, "Verdict": self.verdict,
            "FaultAxis": self.axis, "SeenCounter": max(self._a.counter, 0), "EventCount": self.events,
            "ProfileCheck": self.profile_check,
        }  # fmt: skip
        out = [message.frame(values) for message in self._sent if message.due(now_ns, changed)]
        if now_ns >= self._heartbeat_ns:
            out.append((HEARTBEAT_KEY, b"\x05" if self._heartbeat_ns else b"\x00"))
            self._heartbeat_ns = now_ns + HEARTBEAT_NS
        return out

    def hear(self, action: int, now_ns: int) -> None:
        """Take what a person asks for, heard from that person and not the controller; nothing moves without an ARM."""
        if action == _ARM:
            self._armed, self._operated_ns = self.enabled, now_ns
        elif action in _ENDS and self._armed:
            self._armed, self._stopped_ns, self._open_pct = False, now_ns, self._opening_pct()

    @property
    def keys_of_buses(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Keys to receive from crane0 and from mach0: the watched ones, and the guard's own, which nobody may send."""
        keys = (*self._watches, *self.joints, *self._own_keys)
        return tuple(k for k in keys if not k & EXTENDED), tuple(k for k in keys if k & EXTENDED)

    @property
    def enabled(self) -> bool:
        """Whether the machine may move."""
        return self.verdict is Verdict.GOOD

    def _receive(self, frame: Frame, now_ns: int) -> Finding:
        watch = self._watches.get(frame.key)
        if watch is None:
            joint = self.joints.get(frame.key)
            if joint is not None:
                joint.receive(frame, now_ns)
            return (Verdict.OTHER_GUARD, NO_AXIS) if frame.key in self._own_keys else FINE
        before_ns = watch.stamp_ns
        effect = watch.receive(frame, now_ns)
        if effect >= FrameEffect.GAP:
            return watch.breaks[effect - FrameEffect.GAP], NO_AXIS
        if effect is FrameEffect.NONE or watch not in self._punctuality:
            return FINE
        late = self._punctuality[watch].late(watch.stamp_ns, watch.steps, watch.layout.timeout_ns)
        elapsed_s = (watch.stamp_ns - before_ns) * 1e-9
        if watch not in self._commands_of:
            assert self._carrier is not None
            found = self._carrier.receive(watch, elapsed_s)
            return (Verdict.STALE, NO_AXIS) if late and found is FINE else found
        for command in self._commands_of[watch]:
            verdict = command.receive(watch.word, elapsed_s)
            if verdict is not Verdict.GOOD:
                return verdict, command.axis.number
        return (Verdict.STALE if late else Verdict.GOOD), NO_AXIS

    def _reset_pressed(self) -> bool:
        """Tell whether the reset button went down, as the safety module itself reports it."""
        before = self._reset_seen
        self._reset_seen = not self._estop.trusted or self._estop.raw("ResetReq") == _PRESSED
        return self._reset_seen and not before and self._estop.trusted

    def _check_state(self, now_ns: int, elapsed_s: float) -> Finding:
        """Check the rules on the present state, in the order of the module's docstring."""
        estop_old, a_old, b_old = (watch.old(now_ns) for watch in (self._estop, self._a, self._b))
        heard = not a_old and not b_old and abs(self._a.stamp_ns - self._b.stamp_ns) <= self._apart_ns
        if heard:
            self._heard_ns = now_ns
        motion = self._check_motion(heard, now_ns, elapsed_s)
        neutral = self._neutral()
        carrier = FINE if self._carrier is None else self._carrier.check(heard and self._crane_moves(), now_ns)
        if estop_old:
            self._reset_seen = True
            return Verdict.ESTOP_LOST, NO_AXIS
        if self._estop.raw("ChannelA") != _RELEASED or self._estop.raw("ChannelB") != _RELEASED:
            return Verdict.ESTOP, NO_AXIS
        if motion is not FINE:
            return motion
        if not heard:
            return Verdict.NO_COMMAND, NO_AXIS
        if self._a.raw("Mode") not in (_NEUTRAL, _SPOOL):
            return Verdict.RANGE, NO_AXIS
        if self._b.raw("Aux") != 0:
            return Verdict.RANGE, AUX_AXIS
        if not self._grapple_field.inside(self._b.raw("Grapple")):
            return Verdict.RANGE, GRAPPLE_AXIS
        if self._estop.raw("Person") not in _PERSON:
            self._clear_ns = now_ns
        if carrier is not FINE:
            return carrier
        if self._carrier is not None and self._carrier.driven and now_ns - self._clear_ns > PERSON_CARRIER_NS:
            return Verdict.PERSON, DRIVE_AXIS
        if not self._status.old(now_ns) and self._status.raw("Mode") in _OPERATING:
            self._operated_ns = now_ns
        if self._armed and now_ns - self._operated_ns > AGREE_NS:  # it stopped by itself, and the carrier brakes
            self._armed, self._stopped_ns = False, self._operated_ns
        carried = self._carrier is not None and (self._carrier.driven or self._carrier.raised)
        if carried and self.enabled and not self._armed and now_ns - self._stopped_ns > PERSON_CARRIER_NS:
            return Verdict.NOT_ARMED, DRIVE_AXIS
        if neutral or self._operated_ns == now_ns:
            self._agreed_ns = now_ns
        return FINE if neutral else self._check_commanded(now_ns)

    def _check_motion(self, heard: bool, now_ns: int, elapsed_s: float) -> Finding:
        """Find motion that nobody commands, or too fast a one; the valve node obeys only what is heard, in its mode."""
        words = {message: None if message.old(now_ns) else message.word for message in self._feedback}
        follows = heard and self._a.raw("Mode") == _SPOOL
        first = FINE
        pressed = now_ns - self._jaws_ns <= PRESSED_NS
        jaws = _GRAPPLE_SIDE[self._b.raw("GrappleMode")] if heard else 0.0
        self._jaws_ns = now_ns if jaws else self._jaws_ns
        percents = [*(command.percent if follows else 0.0 for command in self._commands), jaws]
        for feedback, watch in self.motion:
            found = watch.check(percents[watch.number], words[feedback], now_ns, elapsed_s, pressed)
            first = found if first is FINE else first
        for joint in self.joints.values():
            if joint.too_fast() and first is FINE:
                first = Verdict.OVERSPEED, joint.axis.number
            joint.expect(self._commands[joint.axis.number].speed if follows else 0.0)
        return first

    def _check_commanded(self, now_ns: int) -> Finding:
        """Check the rules on a crane that is commanded to move."""
        if self._b.raw("ArmKey") != ARM_KEY:
            return Verdict.NOT_ARMED, NO_AXIS
        if now_ns - self._clear_ns > PERSON_NS:
            return Verdict.PERSON, NO_AXIS
        if now_ns - self._agreed_ns > AGREE_NS:
            return Verdict.DISAGREE, NO_AXIS
        if self.enabled and not self._armed and not self._stopping(now_ns):
            return Verdict.NOT_ARMED, NO_AXIS
        for joint in self.joints.values():
            if joint.silent(now_ns):
                return Verdict.ENCODER, joint.axis.number
        self._beyond = 0 if (found := self._check_place()) is FINE else self._beyond + 1
        return found if self._beyond >= BEYOND_STEPS else FINE

    def _check_place(self) -> Finding:
        """Check the rules on where the crane is and whereto its commands lead."""
        for joint in self.joints.values():
            outward = self._commands[joint.axis.number].percent * joint.axis.sign
            beyond = joint.position - joint.axis.upper if outward > 0.0 else joint.axis.lower - joint.position
            if outward and beyond > RANGE_MARGIN_UNITS:
                return Verdict.OUTSIDE, joint.axis.number
        at = [joint.position for joint in self.joints.values() if joint.axis.number < 4]
        deeper = len(at) == 4 and self._reach.deeper(at, [command.speed for command in self._commands[:4]])
        return (Verdict.REACH, NO_AXIS) if deeper else FINE

    def _neutral(self) -> bool:
        if self._b.raw("GrappleMode") in (_GRAPPLE_OPENS, _GRAPPLE_CLOSES):  # these move at full flow by themselves
            return False
        return self._b.raw("Grapple") == 0 and all(command.percent == 0.0 for command in self._commands)

    def _opening_pct(self) -> float:
        """Tell how far the spools are commanded to open past their dead-bands, all together."""
        return sum(abs(command.opening) for command in self._commands)

    def _stopping(self, now_ns: int) -> bool:
        """Tell whether the spools go to neutral as after a person's STOP."""
        since_ns, most_pct = now_ns - self._stopped_ns, max(STOP_SHARE * self._open_pct, STOP_PCT)
        return since_ns <= STOP_NS or (since_ns <= RAMP_NS and self._opening_pct() <= most_pct)

    def _crane_moves(self) -> bool:
        return any(abs(command.opening) > HELD_PCT for command in self._commands)

    def _settle(self, verdict: Verdict, axis: int, pressed: bool, now_ns: int) -> bool:
        """Count a broken rule at once; the return needs a while of neutral commands, and a person if it latches.

        Returns whether there is something new to tell.
        """
        if verdict is not Verdict.GOOD:
            self._calm_ns = now_ns + CALM_NS
            self.latched = self.latched or verdict in LATCHING
            self._armed = False
        elif self.verdict is not Verdict.GOOD:
            neutral = self._neutral() and not (self._carrier and (self._carrier.driven or self._carrier.raised))
            if not neutral:
                self._calm_ns = now_ns + CALM_NS
            self.latched = self.latched and not (pressed and neutral)
            if self.latched or now_ns < self._calm_ns:
                verdict = Verdict.LATCHED if self.latched else Verdict.CALMING
        supply = not self.latched and now_ns - self._heard_ns <= SILENCE_NS
        changed = verdict is not self.verdict or supply != self._supply
        self.events = (self.events + (verdict is not self.verdict)) & 0xFF
        self.verdict, self.axis, self._supply = verdict, axis, supply
        return changed
