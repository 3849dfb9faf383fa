"""Commissioning: what a machine's valves, sensors and steel really do, found through the bus (docs/architecture.md, "Machine and truth")."""
