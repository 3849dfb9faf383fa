"""Hardware in the loop: runs the whole machine, emulated, in lockstep or live."""
