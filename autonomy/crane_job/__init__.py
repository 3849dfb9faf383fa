"""One crane job as a state machine: its phases, their motions, the grapple, and what the log list says about the
load."""
