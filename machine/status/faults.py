"""Every reason with its reaction, detection bound, a sentence for the operator and what to do about it."""

from __future__ import annotations

from typing import Final

from machine.status.reasons import DetailKind, Fault, Reaction, Reason

NOTE, REFUSE, DEGRADE, HOLD, RAMP, CUT = Reaction
NOTHING, JOINT, NODE, BUS, ARM = DetailKind

_FAULTS: Final = {
    Reason.NONE: Fault(NOTE, 0, NOTHING, "All is well."),
    Reason.NODE_ABSENT: Fault(REFUSE, 2000, NODE, "{} does not answer on the bus"),
    Reason.NODE_IDENTITY: Fault(REFUSE, 2000, NODE, "{} is not the device the profile names"),
    Reason.NODE_CONFIGURATION: Fault(REFUSE, 2000, NODE, "{} refuses its configuration"),
    Reason.INPUT_MISSING: Fault(REFUSE, 0, NOTHING, "Arming is refused: an input is missing or stale"),
    Reason.GUARD_NOT_READY: Fault(REFUSE, 0, NOTHING, "Arming is refused: the guard does not enable"),
    Reason.ESTOP_NOT_RELEASED: Fault(REFUSE, 0, NOTHING, "Arming is refused: the emergency stop is not released"),
    Reason.VALVE_NODE_NOT_READY: Fault(REFUSE, 0, NOTHING, "Arming is refused: the valve node is not operational"),
    Reason.FAULT_LATCHED: Fault(REFUSE, 0, NOTHING, "Arming is refused: a fault is latched"),
    Reason.STILL_STOPPING: Fault(REFUSE, 0, NOTHING, "Arming is refused: the machine is still stopping"),
    Reason.NODE_NOT_OPERATIONAL: Fault(REFUSE, 2000, NODE, "Arming is refused: {} is not operational"),
    Reason.BUS_UNSTABLE: Fault(
        REFUSE, 0, BUS, "Arming is refused: {} was lost and came back three times within a minute"
    ),
    Reason.JOINT_MOVES: Fault(REFUSE, 0, JOINT, "Arming is refused: {} moves without a command"),
    Reason.CONTROLLER_ENDED: Fault(NOTE, 0, NOTHING, "The controller has ended"),
    Reason.OPERATOR_STOP: Fault(HOLD, 0, NOTHING, "The operator stopped the machine"),
    Reason.OPERATOR_DISARM: Fault(HOLD, 0, NOTHING, "The operator disarmed the machine"),
    Reason.OPERATOR_LINK_LOST: Fault(HOLD, 1000, NOTHING, "The operator who watches no longer reaches the machine"),
    Reason.ESTOP_PRESSED: Fault(CUT, 15, NOTHING, "The emergency stop is pressed", always=True),
    Reason.ESTOP_CHANNELS: Fault(
        CUT, 20, NOTHING, "The emergency stop channels disagree or report an error", always=True
    ),
    Reason.ESTOP_LOST: Fault(CUT, 40, NOTHING, "The emergency stop state is no longer received"),
    Reason.GUARD_LOST: Fault(CUT, 60, NOTHING, "The guard is no longer received"),
    Reason.GUARD_REFUSES: Fault(CUT, 20, NOTHING, "The guard withdrew its enable"),
    Reason.ENCODER_LOST: Fault(RAMP, 20, JOINT, "The encoder of {} is no longer received"),
    Reason.ENCODER_JUMP: Fault(RAMP, 10, JOINT, "The encoder of {} jumps faster than the joint can move"),
    Reason.ENCODER_FROZEN: Fault(RAMP, 300, JOINT, "The encoder of {} sends the same sample again and again"),
    Reason.ENCODER_NOISY: Fault(
        DEGRADE, 500, JOINT, "The encoder of {} is much noisier than it was, or than its profile says; half speed"
    ),
    Reason.ENCODER_DRIFT: Fault(
        HOLD, 6000, JOINT, "{} creeps by its encoder while its valve is shut, and its law pulls it back again and again"
    ),
    Reason.ENCODER_ALARM: Fault(RAMP, 20, JOINT, "The encoder of {} reports an alarm"),
    Reason.POSITION_OUTSIDE: Fault(RAMP, 20, JOINT, "{} is outside its range"),
    Reason.VALVE_FEEDBACK_LOST: Fault(RAMP, 20, NOTHING, "The valve node's feedback is no longer received"),
    Reason.VALVE_ECHO_STUCK: Fault(RAMP, 35, NOTHING, "The valve node does not accept the controller's commands"),
    Reason.VALVE_NODE_FAULT: Fault(RAMP, 20, NOTHING, "The valve node reports a fault or a cut pilot supply"),
    Reason.PLC_LOST: Fault(CUT, 100, NOTHING, "The machine PLC's status is no longer received"),
    Reason.PLC_FAULT: Fault(RAMP, 30, NOTHING, "The machine PLC reports a fault"),
    Reason.PRESSURE_LOST: Fault(DEGRADE, 110, NOTHING, "A pressure module is no longer received; half speed"),
    Reason.GRAPPLE_STATUS_LOST: Fault(DEGRADE, 110, NOTHING, "The grapple status is no longer received; half speed"),
    Reason.SAFETY_NODE_LOST: Fault(CUT, 260, NODE, "The heartbeat of {} is lost"),
    Reason.ENCODER_NODE_LOST: Fault(RAMP, 260, NODE, "The heartbeat of {} is lost"),
    Reason.PRESSURE_NODE_LOST: Fault(DEGRADE, 260, NODE, "The heartbeat of {} is lost; half speed"),
    Reason.NODE_RESTARTED: Fault(RAMP, 105, NODE, "{} restarted or left the operational state"),
    Reason.EMERGENCY_MESSAGE: Fault(RAMP, 5, NODE, "{} sends an emergency message"),
    Reason.EMERGENCY_WARNING: Fault(DEGRADE, 5, NODE, "{} sends a warning; half speed"),
    Reason.PERSON_IN_ZONE: Fault(
        HOLD, 20, NOTHING, "A person is in the machine's zone, or the detector of persons has failed"
    ),
    Reason.LEVER_MOVED: Fault(
        HOLD, 20, NOTHING, "A hand lever was moved or its switch is faulty: automatic work has ended"
    ),
    Reason.CARRIER_LOST: Fault(CUT, 100, NOTHING, "The carrier's state is no longer received"),
    Reason.SWING_ARMS_LOST: Fault(CUT, 100, NOTHING, "The heights of the swing arms are no longer received"),
    Reason.GNSS_LOST: Fault(NOTE, 510, NOTHING, "Position or heading is no longer received"),
    Reason.ENGINE_LOST: Fault(NOTE, 110, NOTHING, "The engine is no longer received"),
    Reason.BUS_OFF: Fault(CUT, 20, BUS, "The CAN controller on {} is bus-off", always=True),
    Reason.BUS_DOWN: Fault(CUT, 20, BUS, "The CAN interface of {} is down", always=True),
    Reason.INPUTS_LOST: Fault(CUT, 20, BUS, "Several inputs on {} are lost at the same moment"),
    Reason.BUS_PASSIVE: Fault(DEGRADE, 100, BUS, "{} is error-passive; half speed"),
    Reason.SEND_REFUSED: Fault(RAMP, 60, BUS, "The transmit queue of {} was full three times in a row"),
    Reason.FOREIGN_CONTROLLER: Fault(
        CUT, 20, BUS, "Another controller sends this controller's frames on {}", always=True
    ),
    Reason.ADDRESS_LOST: Fault(
        RAMP, 20, NOTHING, "Another device uses the controller's address 27h on the machine bus"
    ),
    Reason.LOOP_LATE: Fault(
        DEGRADE, 5, NOTHING, "The control loop was late by more than two periods and 10 ms; half speed"
    ),
    Reason.LOOP_STALLED: Fault(
        HOLD, 15, NOTHING, "The control loop was late three times in a second, or by more than 50 ms"
    ),
    Reason.COMPUTER_STALLED: Fault(CUT, 20, NOTHING, "This computer stood still, so that inputs were lost"),
    Reason.PROFILE_DIFFERS: Fault(CUT, 60, NOTHING, "The guard runs on another profile file than the controller"),
    Reason.LEASE_LOST: Fault(HOLD, 10, NOTHING, "The planner's setpoints ended while moving"),
    Reason.SETPOINTS_REFUSED: Fault(HOLD, 10, NOTHING, "Three setpoints were refused within a second"),
    Reason.SPOOL_OPEN: Fault(CUT, 150, JOINT, "The valve of {} is further open than commanded"),
    Reason.SPOOL_SHUT: Fault(HOLD, 400, JOINT, "The valve of {} stays shut although it is commanded to open"),
    Reason.SPOOL_WRONG: Fault(DEGRADE, 2000, JOINT, "The valve of {} opens more or less than commanded; half speed"),
    Reason.SPEED_WRONG: Fault(RAMP, 200, JOINT, "{} moves at another speed than its open valve gives"),
    Reason.JOINT_STUCK: Fault(HOLD, 400, JOINT, "{} does not follow its command"),
    Reason.JOINT_RUNAWAY: Fault(CUT, 150, JOINT, "{} moves without a command"),
    Reason.JOINT_REVERSED: Fault(RAMP, 200, JOINT, "{} moves against its command"),
    Reason.MOVES_WHILE_STOPPED: Fault(CUT, 600, JOINT, "{} moves although the machine is stopped", always=True),
    Reason.OVERLOAD: Fault(HOLD, 50, NOTHING, "Load, reach and slope together are more than the machine bears"),
    Reason.OVERLOADED: Fault(DEGRADE, 50, NOTHING, "The machine bears no more: nothing goes outward or up; half speed"),
    Reason.HOSE_BURST: Fault(CUT, 100, JOINT, "The oil that carries {} is gone: a hose or a pipe has burst"),
    Reason.TEST_RANGE: Fault(HOLD, 10, JOINT, "The spool test of {} reaches the end of its range"),
    Reason.TEST_SPEED: Fault(HOLD, 10, JOINT, "{} moves faster in a spool test than its limit"),
    Reason.TEST_TOO_LONG: Fault(HOLD, 10, JOINT, "The spool test of {} lasts too long without a pause"),
    # driving: position, heading, carrier, steering, swing arms
    Reason.POSITION_LOST: Fault(HOLD, 510, NOTHING, "The position was lost while driving to a waypoint"),
    Reason.HEADING_LOST: Fault(HOLD, 310, NOTHING, "The heading was lost while driving to a waypoint"),
    Reason.FIX_LOST: Fault(
        HOLD, 1200, NOTHING, "The position is neither RTK fixed nor float while driving to a waypoint"
    ),
    Reason.POSITION_JUMP: Fault(HOLD, 310, NOTHING, "The position jumped while driving to a waypoint"),
    Reason.HEADING_JUMP: Fault(HOLD, 310, NOTHING, "The heading jumped while driving to a waypoint"),
    Reason.HEADING_FROZEN: Fault(HOLD, 710, NOTHING, "The heading does not change while the machine turns"),
    Reason.HEADING_REVERSED: Fault(HOLD, 860, NOTHING, "The machine does not move in the direction of its heading"),
    Reason.CARRIER_FAULT: Fault(RAMP, 110, NOTHING, "The vehicle controller reports a fault while driving"),
    Reason.CARRIER_RUNAWAY: Fault(
        CUT, 500, NOTHING, "The carrier moves faster than commanded, or in the opposite direction"
    ),
    Reason.CARRIER_STUCK: Fault(HOLD, 2600, NOTHING, "The carrier does not move although it is commanded to"),
    Reason.STEERING_DISAGREES: Fault(
        RAMP, 310, NOTHING, "The articulation's encoder and the vehicle controller disagree on the angle"
    ),
    Reason.TILTED: Fault(HOLD, 110, NOTHING, "The machine tilts beyond the limit for driving"),
    Reason.ARMS_FAULT: Fault(RAMP, 110, NOTHING, "The swing-arm controller reports a fault while driving"),
    Reason.ARM_OUTSIDE: Fault(HOLD, 60, ARM, "The {} arm is outside its travel"),
    Reason.ARM_STUCK: Fault(HOLD, 2100, ARM, "The {} arm does not follow its command"),
    Reason.STEERING_STUCK: Fault(HOLD, 900, NOTHING, "The articulation does not follow its command"),
    Reason.STEERING_RUNAWAY: Fault(CUT, 500, NOTHING, "The articulation moves without a command, or against it"),
    # refusals of a datagram as a whole, on arrival
    Reason.DATAGRAM_LENGTH: Fault(REFUSE, 10, NOTHING, "A datagram of wrong length was refused"),
    Reason.DATAGRAM_MAGIC: Fault(REFUSE, 10, NOTHING, "A foreign datagram was refused"),
    Reason.DATAGRAM_VERSION: Fault(REFUSE, 10, NOTHING, "A datagram of another version was refused"),
    Reason.DATAGRAM_KIND: Fault(
        REFUSE, 10, NOTHING, "A datagram of a kind that the controller does not accept was refused"
    ),
    Reason.DATAGRAM_CRC: Fault(REFUSE, 10, NOTHING, "A corrupt datagram was refused"),
    Reason.DATAGRAM_AUTHENTICATION: Fault(REFUSE, 10, NOTHING, "A datagram without the right key was refused"),
    Reason.DATAGRAM_NOT_FINITE: Fault(REFUSE, 10, NOTHING, "A datagram with NaN or infinity was refused"),
    Reason.DATAGRAM_VALUE: Fault(REFUSE, 10, NOTHING, "A datagram with an illegal value was refused"),
    Reason.WRONG_PROFILE: Fault(REFUSE, 10, NOTHING, "A datagram for another profile was refused"),
    Reason.OUT_OF_ORDER: Fault(REFUSE, 10, NOTHING, "A repeated or reordered datagram was refused"),
    Reason.STAMP_FUTURE: Fault(REFUSE, 10, NOTHING, "A datagram stamped in the future was refused"),
    Reason.STAMP_OLD: Fault(REFUSE, 10, NOTHING, "A datagram that arrived too late was refused"),
    Reason.LEASE_TOO_LONG: Fault(REFUSE, 10, NOTHING, "A setpoint with a lease over the limit was refused"),
    Reason.NOT_ARMED: Fault(REFUSE, 10, NOTHING, "A setpoint was refused: the machine is not armed"),
    Reason.JOINT_RANGE: Fault(REFUSE, 10, JOINT, "A setpoint was refused: {} is outside its range"),
    Reason.JOINT_SPEED: Fault(REFUSE, 10, JOINT, "A setpoint was refused: {} is too fast"),
    Reason.REFERENCE_JUMP: Fault(REFUSE, 10, JOINT, "A setpoint was refused: {} would jump from the present reference"),
    Reason.FINAL_MOVING: Fault(REFUSE, 10, JOINT, "A final setpoint was refused: {} does not end at rest"),
    Reason.CANNOT_DRIVE: Fault(REFUSE, 10, NOTHING, "A drive setpoint was refused: this machine cannot drive"),
    Reason.TEST_FUNCTION: Fault(REFUSE, 10, JOINT, "A spool test was refused: {} has no encoder"),
    Reason.TEST_SPOOL: Fault(REFUSE, 10, JOINT, "A spool test was refused: {} would be too fast or start too hard"),
    Reason.TEST_BUSY: Fault(REFUSE, 10, JOINT, "A spool test was refused: a function other than {} still moves"),
    Reason.DRIVE_SPEED: Fault(
        REFUSE, 10, NOTHING, "A drive setpoint was refused: it is too fast, or backward to a waypoint"
    ),
    Reason.DRIVE_WAYPOINT: Fault(REFUSE, 10, NOTHING, "A drive setpoint was refused: its waypoint is not on this site"),
    Reason.DRIVE_ARTICULATION: Fault(
        REFUSE, 10, NOTHING, "A drive setpoint was refused: the articulation bends too far or too fast"
    ),
    Reason.DRIVE_HEIGHT: Fault(REFUSE, 10, ARM, "A drive setpoint was refused: the {} arm is outside its travel"),
    Reason.FLOAT_BOTH: Fault(REFUSE, 10, NOTHING, "A drive setpoint was refused: both axles would float"),
    Reason.CRANE_MOVES: Fault(REFUSE, 10, NOTHING, "A drive setpoint was refused: the crane is moving"),
    Reason.CARRIER_MOVES: Fault(REFUSE, 10, NOTHING, "A crane setpoint was refused: the machine is driving"),
    Reason.BELOW_GROUND: Fault(REFUSE, 10, NOTHING, "A setpoint was refused: the grapple would enter the ground"),
    Reason.KEEP_OUT: Fault(
        REFUSE, 10, NOTHING, "A setpoint was refused: the boom tip would enter a box that it must keep out of"
    ),
    Reason.RAISES_MOMENT: Fault(
        REFUSE, 10, NOTHING, "A setpoint was refused: the machine is overloaded and the load would go outward or up"
    ),
    Reason.NO_AUTHORITY: Fault(REFUSE, 10, NOTHING, "Only an operator may arm, disarm or reset"),
}
"""All but what to do: reaction, bound [ms], what the detail names, sentence with its place, whether always latched."""

_PLANNER: Final = "See the planner's journal."
ADVICE: Final = {
    Reason.NONE: "Nothing to do.",
    Reason.NODE_ABSENT: "Check its power, node id and cable.",
    Reason.NODE_IDENTITY: "Compare objects 1000h, 1018h, 6001h, 6002h and 6005h with the profile, then reset.",
    Reason.NODE_CONFIGURATION: "Check the device's EDS, power it off and on, then reset.",
    Reason.INPUT_MISSING: "See the stale mask for the missing frames and start that node.",
    Reason.GUARD_NOT_READY: "Start the guard or read its verdict.",
    Reason.ESTOP_NOT_RELEASED: "Release it, then reset.",
    Reason.VALVE_NODE_NOT_READY: "Check the machine PLC.",
    Reason.FAULT_LATCHED: "Reset, then arm.",
    Reason.STILL_STOPPING: "Arm again when it stands still.",
    Reason.NODE_NOT_OPERATIONAL: "Check its power, cable and NMT state.",
    Reason.BUS_UNSTABLE: "Check cable, termination and bit rate, and arm after a quiet minute.",
    Reason.JOINT_MOVES: "Leave the hand lever; if nobody moves it, cut the pilot supply and check its valve.",
    Reason.CONTROLLER_ENDED: "Start it again.",
    Reason.OPERATOR_STOP: "Arm to continue.",
    Reason.OPERATOR_DISARM: "Arm to continue.",
    Reason.OPERATOR_LINK_LOST: (
        "Open the operator's page again, or end the watch by `timberhand operator unwatch`; then arm."
    ),
    Reason.ESTOP_PRESSED: "Release, reset and arm again.",
    Reason.ESTOP_CHANNELS: "Check the stop circuit's wiring, then reset and arm.",
    Reason.ESTOP_LOST: "Check the safety module, then reset.",
    Reason.GUARD_LOST: "Start the guard, then reset.",
    Reason.GUARD_REFUSES: "Read the guard's verdict, press reset on the safety module, then arm.",
    Reason.ENCODER_LOST: "Check its cable, then reset and arm.",
    Reason.ENCODER_JUMP: "Check its coupling and shield, then reset and arm.",
    Reason.ENCODER_FROZEN: (
        "Its bus works and its measurement does not: check the device and its coupling, then reset and arm."
    ),
    Reason.ENCODER_NOISY: "Check its shield, supply and coupling.",
    Reason.ENCODER_DRIFT: "Compare the joint with its encoder: it drifts, or the valve leaks; then arm.",
    Reason.ENCODER_ALARM: "Read objects 6503h or 5122h, then reset.",
    Reason.POSITION_OUTSIDE: "Move it back by hand lever, then reset and arm.",
    Reason.VALVE_FEEDBACK_LOST: "Check the machine PLC, then reset.",
    Reason.VALVE_ECHO_STUCK: "Check the bus to the machine PLC and its exit code, then reset.",
    Reason.VALVE_NODE_FAULT: "Read its exit code, then reset.",
    Reason.PLC_LOST: "Check the machine PLC, then reset.",
    Reason.PLC_FAULT: "Read its fault bits, then reset and arm.",
    Reason.PRESSURE_LOST: "Check the pressure modules.",
    Reason.GRAPPLE_STATUS_LOST: "Check the machine PLC.",
    Reason.SAFETY_NODE_LOST: "Check this node's power and cable, then reset and arm.",
    Reason.ENCODER_NODE_LOST: "Check this encoder's power and cable, then reset.",
    Reason.PRESSURE_NODE_LOST: "Check the pressure modules.",
    Reason.NODE_RESTARTED: "Find the cause, then reset and arm.",
    Reason.EMERGENCY_MESSAGE: "Read its error register, then reset and arm.",
    Reason.EMERGENCY_WARNING: "Read its error register (1001h, 1003h).",
    Reason.PERSON_IN_ZONE: "Clear the zone and check the detector, then arm.",
    Reason.LEVER_MOVED: "Leave the levers in neutral, then arm; if nobody moved one, check its switch.",
    Reason.CARRIER_LOST: "Check the vehicle controller and the machine bus, then reset and arm.",
    Reason.SWING_ARMS_LOST: "Check the swing-arm controller and the machine bus, then reset and arm.",
    Reason.GNSS_LOST: "Check the GNSS receiver; crane work can continue.",
    Reason.ENGINE_LOST: "Check the engine controller; crane work can continue.",
    Reason.BUS_OFF: "Check cable and termination, then reset and arm.",
    Reason.BUS_DOWN: "Bring the interface up, then reset and arm.",
    Reason.INPUTS_LOST: (
        "Check the plug and the supply that they share, or, where this computer emulates the machine, run "
        "`timberhand doctor --rt`; then reset and arm."
    ),
    Reason.BUS_PASSIVE: "Check cable, termination and bit rate.",
    Reason.SEND_REFUSED: "Check the bus load, then reset.",
    Reason.FOREIGN_CONTROLLER: "Stop the other controller, then reset.",
    Reason.ADDRESS_LOST: "Give that device another address, then reset and arm.",
    Reason.LOOP_LATE: "Free the processor; see docs/how-to/real-time.md.",
    Reason.LOOP_STALLED: "Free the processor; see docs/how-to/real-time.md; then arm.",
    Reason.COMPUTER_STALLED: "Run `timberhand doctor --rt`, end what else runs here, then reset and arm.",
    Reason.PROFILE_DIFFERS: "Restart both, with one profile; then reset and arm.",
    Reason.LEASE_LOST: _PLANNER,
    Reason.SETPOINTS_REFUSED: _PLANNER,
    Reason.SPOOL_OPEN: "Check its spool for dirt and its solenoid, then reset and arm.",
    Reason.SPOOL_SHUT: "Check its spool, solenoid and plug, then arm.",
    Reason.SPOOL_WRONG: "Check pilot pressure and solenoid, and calibrate the valve.",
    Reason.SPEED_WRONG: (
        "Compare the joint with its encoder: check coupling and scale; or calibrate the valve. Then reset and arm."
    ),
    Reason.JOINT_STUCK: "Check for a stuck valve or a frozen encoder, then arm.",
    Reason.JOINT_RUNAWAY: "Check for a valve stuck open, then reset and arm.",
    Reason.JOINT_REVERSED: "Check signs in the profile, then reset and arm.",
    Reason.MOVES_WHILE_STOPPED: (
        "Check for a valve stuck open, then reset and arm; to move it by hand lever, disarm first."
    ),
    Reason.OVERLOAD: "Lower the load or bring it nearer, or arm and command only that.",
    Reason.OVERLOADED: "Lower the load or bring it nearer.",
    Reason.HOSE_BURST: "Stay clear of the load; replace the hose, then reset and arm.",
    Reason.TEST_RANGE: "Start farther from the end, then arm.",
    Reason.TEST_SPEED: "Correct full_speed in the profile, then arm.",
    Reason.TEST_TOO_LONG: "Split it into shorter tests, then arm.",
    Reason.POSITION_LOST: "Check the GNSS receiver, then arm.",
    Reason.HEADING_LOST: "Check both antennas, then arm.",
    Reason.FIX_LOST: "Wait for the fix, or check the correction service; then arm.",
    Reason.POSITION_JUMP: "Compare it with where the machine is, then arm.",
    Reason.HEADING_JUMP: "Compare it with the direction of the front half, then arm.",
    Reason.HEADING_FROZEN: "Restart the GNSS receiver, then arm.",
    Reason.HEADING_REVERSED: "Check that the antennas are not swapped, then arm.",
    Reason.CARRIER_FAULT: "Read its fault number, then reset and arm.",
    Reason.CARRIER_RUNAWAY: "Secure the machine against rolling, check brake and drive; then reset and arm.",
    Reason.CARRIER_STUCK: "Check for an obstacle or a brake that does not open, then arm.",
    Reason.STEERING_DISAGREES: "Check the encoder's zero and coupling, then reset and arm.",
    Reason.TILTED: "Drive it out by hand, straight down the slope.",
    Reason.ARMS_FAULT: "Check that no two float valves are open, then reset and arm.",
    Reason.ARM_OUTSIDE: "Check the sensor of its height, then arm.",
    Reason.ARM_STUCK: "Check for a stuck valve, then arm.",
    Reason.STEERING_STUCK: "Check for a stuck steering valve or an object between the wheels, then arm.",
    Reason.STEERING_RUNAWAY: "Check for a steering valve stuck open, then reset and arm.",
    Reason.DATAGRAM_LENGTH: _PLANNER,
    Reason.DATAGRAM_MAGIC: _PLANNER,
    Reason.DATAGRAM_VERSION: "Run the same release on both sides.",
    Reason.DATAGRAM_KIND: _PLANNER,
    Reason.DATAGRAM_CRC: _PLANNER,
    Reason.DATAGRAM_AUTHENTICATION: "Give both sides the same key; the controller's status names the sender's port.",
    Reason.DATAGRAM_NOT_FINITE: _PLANNER,
    Reason.DATAGRAM_VALUE: _PLANNER,
    Reason.WRONG_PROFILE: "Start both sides with the same profile.",
    Reason.OUT_OF_ORDER: _PLANNER,
    Reason.STAMP_FUTURE: "Both sides must use the same clock.",
    Reason.STAMP_OLD: "The sender or the network is slow.",
    Reason.LEASE_TOO_LONG: "Request a shorter lease.",
    Reason.NOT_ARMED: "Arm first.",
    Reason.JOINT_RANGE: _PLANNER,
    Reason.JOINT_SPEED: _PLANNER,
    Reason.REFERENCE_JUMP: _PLANNER,
    Reason.FINAL_MOVING: _PLANNER,
    Reason.CANNOT_DRIVE: "Plan crane work only.",
    Reason.TEST_FUNCTION: "Test joints with an encoder only.",
    Reason.TEST_SPOOL: _PLANNER,
    Reason.TEST_BUSY: _PLANNER,
    Reason.DRIVE_SPEED: _PLANNER,
    Reason.DRIVE_WAYPOINT: _PLANNER,
    Reason.DRIVE_ARTICULATION: _PLANNER,
    Reason.DRIVE_HEIGHT: _PLANNER,
    Reason.FLOAT_BOTH: _PLANNER,
    Reason.CRANE_MOVES: "Drive when the crane is at rest.",
    Reason.CARRIER_MOVES: "Move the crane when the machine stands still.",
    Reason.BELOW_GROUND: _PLANNER,
    Reason.KEEP_OUT: _PLANNER,
    Reason.RAISES_MOMENT: "Lower the load or bring it nearer.",
    Reason.NO_AUTHORITY: "Send it through the operator's socket, as a user of its group.",
}
"""What the operator should do, in the order of the faults."""

FAULTS: Final[dict[Reason, Fault]] = {
    reason: fault._replace(advice=ADVICE[reason]) for reason, fault in _FAULTS.items()
}
