"""Commissioning: what a machine's valves, sensors and steel really do, found through the bus (design section 6)."""
