"""Measures the real controller process against the host it runs on: a light machine, reference loops, readings."""
