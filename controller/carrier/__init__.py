"""The carrier and its bus mach0: inputs, outputs, dead reckoning, monitors and control."""
