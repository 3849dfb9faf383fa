"""Faults of the plant's own parts: what `sim.plant_faults` switches on and off, and the nodes and valves obey."""
