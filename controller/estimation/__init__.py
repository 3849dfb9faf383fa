"""Estimates from measurements: joint positions and velocities, the load, and whether a joint follows its command."""
