"""Commissioning: identifies a machine's valves, sensors and steel through its bus (design section 6)."""
