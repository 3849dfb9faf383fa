"""Calibration of a virtual machine, and the emulated survey of its cameras."""
