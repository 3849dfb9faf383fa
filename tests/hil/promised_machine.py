"""A whole machine on virtual buses with everything around it that can go wrong, and the promise as a monitor.

Controller and guard are real, so are the emulated nodes; only the joints follow their valves without physics.  The
monitor looks at what the *valve node* does, at the frames that were damaged on the bus and at what persons pressed; it
knows nothing of the controller's or the guard's reasoning.  The promise (docs/reference/safety.md, section 2):

1. Within 100 ms of the loss of a needed input the spools are neutral.
2. After a stop nothing moves before a person has armed again, and after an emergency stop not before its reset either.
3. No spool leaves the envelope: not further open than the joint's speed limit needs, and not outward beyond its range.
"""

from __future__ import annotations

from typing import Any, Final

from can_dbc.dbc.codec import load as load_dbc
from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, Knot, OperatorAction, OperatorCommand, StateReport
from can_dbc.messages.datagrams import encode
from can_dbc.protocols.canopen import SYNC_ID
from controller.config import load
from controller.guard.__main__ import build, profile_path
from controller.laws.valve_map import ValveMap
from hil.harness.lockstep import SLICE_NS, Lockstep, Observer
from hil.wire.faults import FOREVER_NS, Fault, Kind
from machine.joints import JOINTS
from machine.profile import SPEED_HEADROOM_SHARE, joint
from machine.status.modes import Mode
from sim.kinematic import KinematicMachine
from tests.hil.stand_ins import Blind

MS: Final = 1_000_000
PROFILE: Final = "palms_471"
SETTINGS: Final = load(PROFILE)
DATABASE: Final = load_dbc("crane")
PROMISE_NS: Final = 100 * MS
STOP_NS: Final = 200 * MS
"""A stop's ramp (150 ms) with the tick and the frame that carry it."""
MARGIN_PCT: Final = 0.1
NEEDED: Final = {
    "EstopStat": 10,
    "GuardStat": 10,
    "EncSlew": 5,
    "EncLift": 5,
    "EncTilt": 5,
    "EncExt": 5,
    "EncRot": 5,
    "ValveFbA": 5,
    "ValveFbB": 5,
    "PlcStatus": 20,
    "ValveCmdA": 5,
    "ValveCmdB": 5,
    "Sync": 5,
}
"""Messages without which nothing may move, with their period [ms]."""
SPECS: Final = [joint(SETTINGS.profile, j) for j in JOINTS]
FUNCTIONS: Final = ("slew", "lift", "tilt", "ext", "rot")


class Planner:
    """Moves one joint to and fro, or misbehaves."""

    def __init__(self) -> None:
        self.system: Any = None
        self.doing = "silent"
        self.joint, self.speed = 0, 0.06
        self._sequence = 0
        self._next_ns = 0
        self._sent: list[bytes] = []

    def step(self, now_ns: int, report: StateReport | None, logs: object) -> list[bytes]:
        """The datagrams of this tick."""
        if now_ns < self._next_ns or self.doing in ("silent", "frozen"):
            return []
        self._next_ns = now_ns + 50 * MS
        if self.doing == "replays":
            return self._sent[-3:]
        if self.doing == "rubbish":
            return [bytes(40), self._sent[-1][:-1] if self._sent else b"x"]
        reference = list(self.system._controller.reference_position)
        if any(value != value for value in reference):
            return []
        spec = SPECS[self.joint]
        if self.doing == "hold":
            speed = 0.0
        else:
            room = 0.1 * (spec.upper - spec.lower)
            if reference[self.joint] > spec.upper - room:
                self.speed = -abs(self.speed)
            elif reference[self.joint] < spec.lower + room:
                self.speed = abs(self.speed)
            speed = self.speed
        end, velocity = list(reference), [0.0] * len(reference)
        end[self.joint] += 0.4 * speed
        velocity[self.joint] = speed
        knots = (Knot(0, tuple(reference), tuple(velocity)), Knot(400 * MS, tuple(end), tuple(velocity)))
        self._sequence += 1
        setpoint = CraneSetpoint(
            self._sequence, SETTINGS.profile_hash, now_ns, 200 * MS, GrappleCommand.HOLD, False, knots
        )
        self._sent = [*self._sent[-20:], encode(setpoint)]
        return self._sent[-1:]


class Person:
    """Presses what a rule tells, with the next report."""

    def __init__(self) -> None:
        self._waiting: list[OperatorAction] = []
        self._sequence = 0

    def press(self, action: OperatorAction) -> None:
        self._waiting.append(action)

    def step(self, report: StateReport) -> bytes | None:
        """The datagram of one press."""
        if not self._waiting:
            return None
        self._sequence += 1
        action = self._waiting.pop(0)
        return encode(OperatorCommand(self._sequence, SETTINGS.profile_hash, report.stamp_ns, action))


class PromiseBroken(AssertionError):
    """The spools did what the promise excludes."""


class PromisedMachine:
    """The system and its monitor; `run` advances both."""

    def __init__(self) -> None:
        self.plant = KinematicMachine(SETTINGS.profile, 1, step_ns=2_500_000)
        self.planner, self.person = Planner(), Person()
        self.observer = Observer()
        self.mode, self.reason = Mode.BOOT, 0
        self.observer.on_report.append(self._note_report)
        self.system = Lockstep(
            SETTINGS, build(profile_path(PROFILE)), self.plant, self.planner, self.person, self.observer, Blind()
        )  # type: ignore[arg-type]
        self.planner.system = self.system
        self.lost: dict[str, int] = {}
        """Message -> when its first frame was lost."""
        self.stopped_ns = 0
        self.armed_ns = -1
        self.estop_ns = 0
        self.reset_ns = 1
        self.moved = False
        """Whether the spools have ever moved."""
        self._maps = [ValveMap(spec.valve) for spec in SPECS]
        self._person_in_zone = False
        self._spy_on_person()

    def _spy_on_person(self) -> None:
        """The safety module of the plant has no person sensor; its frame gets one here."""
        message = self.plant.estop._message
        place = [s.name for s in DATABASE.message("EstopStat").signals].index("Person") - 2
        inner = message.frame

        def frame(*values: Any) -> Any:
            changed = list(values)
            changed[place] = int(self._person_in_zone)
            return inner(*changed)

        message.frame = frame  # type: ignore[method-assign]

    # -- time

    @property
    def now_ns(self) -> int:
        return self.system.now_ns

    def run(self, seconds: float) -> None:
        """Advance; raises PromiseBroken."""
        for _ in range(round(seconds * 1e9 / SLICE_NS)):
            self.system.advance()
            self._judge()

    def boot(self) -> PromisedMachine:
        """Until the machine waits for ARM, armed, and moving."""
        for _ in range(80):
            self.run(0.1)
            if self.mode is Mode.STANDBY and self.reason == 0:
                return self
        raise AssertionError(f"no standby: {self.mode!r}, {self.reason}")

    def start(self) -> None:
        """ARM and a moving planner."""
        self.press(OperatorAction.ARM)
        self.run(0.1)
        self.planner.doing = "hold"
        self.run(0.1)
        self.planner.doing = "moves"
        self.run(0.5)

    def _note_report(self, report: StateReport) -> None:
        before, self.mode, self.reason = self.mode, Mode(report.mode), report.reason & 0xFF
        if self.mode in (Mode.STOP, Mode.FAULT) and before is not self.mode:
            self.stopped_ns = self.now_ns

    # -- what happens

    def press(self, action: OperatorAction) -> None:
        """The operator's page."""
        self.person.press(action)
        if action is OperatorAction.ARM:
            self.armed_ns = self.now_ns
        elif action in (OperatorAction.STOP, OperatorAction.DISARM):
            self.stopped_ns = self.now_ns + 20 * MS  # it leaves with the next report

    def press_emergency_stop(self) -> None:
        self.plant.estop.press()
        self.estop_ns = self.stopped_ns = self.now_ns

    def release_emergency_stop(self) -> None:
        self.plant.estop.release()

    def press_reset_button(self) -> None:
        self.plant.estop.reset()
        if self.plant.estop.channels == (1, 1):
            self.reset_ns = self.now_ns

    def step_into_the_zone(self, inside: bool) -> None:
        self._person_in_zone = inside

    def damage(self, kind: Kind, name: str, duration_s: float, probability: float = 1.0, shift_ns: int = 0) -> None:
        """Damage the frames of one message from now on; a message that is dropped for good counts as lost."""
        key = SYNC_ID if name == "Sync" else DATABASE.message(name).key
        end_ns = self.now_ns + round(duration_s * 1e9) if duration_s else FOREVER_NS
        self.system.core.inject(
            Fault(
                kind,
                self.now_ns,
                end_ns,
                key,
                0x7FF,
                probability=probability,
                shift_ns=shift_ns,
                seed=self.now_ns & 0xFFFF,
            )
        )
        if kind is Kind.DROP and probability == 1.0 and not duration_s:
            self.lost.setdefault(name, self.now_ns + NEEDED[name] * MS)

    def cut(self, participant: str) -> None:
        """Open a cable."""
        self.system.core.inject(Fault(Kind.CUT, self.now_ns, FOREVER_NS, node=participant))
        self.lost.setdefault("ValveCmdA", self.now_ns + NEEDED["ValveCmdA"] * MS)

    def heal(self) -> None:
        """Every damage of the bus ends."""
        self.system.core.heal()
        self.lost.clear()

    # -- the promise

    def _judge(self) -> None:
        now_ns, spools = self.now_ns, self.plant.valve.outputs_pct
        neutral = not any(spools[:5]) and spools[5] <= 0.0
        self.moved = self.moved or any(spools[:5])
        if not neutral:
            for name, since_ns in self.lost.items():
                if now_ns > since_ns + PROMISE_NS:
                    raise PromiseBroken(f"{name} is lost since {(now_ns - since_ns) / MS:.1f} ms: {spools}")
            if self.stopped_ns > self.armed_ns and now_ns > self.stopped_ns + STOP_NS:
                raise PromiseBroken(f"stopped {(now_ns - self.stopped_ns) / MS:.1f} ms ago, nobody armed: {spools}")
            if self.estop_ns > self.reset_ns and now_ns > self.estop_ns + PROMISE_NS:
                raise PromiseBroken(f"the emergency stop was pressed and not reset: {spools}")
        for place, (name, spec, made) in enumerate(zip(FUNCTIONS, SPECS, self._maps, strict=True)):
            position, pct = self.plant.world.q[name], spools[place]
            if not pct:
                continue
            made.set_position(position)
            limit = SPEED_HEADROOM_SHARE * spec.speed_limit
            low, high = sorted((made.spool_pct(-limit), made.spool_pct(limit)))
            if not low - MARGIN_PCT <= pct <= high + MARGIN_PCT:
                raise PromiseBroken(f"{name} at {pct:.2f} %, allowed {low:.2f} to {high:.2f} %")
            outward = pct * spec.valve.sign
            if (position > spec.upper + 0.08 and outward > 0.0) or (position < spec.lower - 0.08 and outward < 0.0):
                raise PromiseBroken(f"{name} at {position:.3f} is driven further out")
