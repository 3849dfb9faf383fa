"""Commissioning: identifies a machine's valves, sensors and steel through its bus (docs/architecture.md, "Machine and
truth")."""
