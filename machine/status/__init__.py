"""Modes, reasons and faults: the vocabulary in which the controller reports its state."""
