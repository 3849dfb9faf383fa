"""The emulated machine PLC: what stands between Ethernet and the valves on a machine like paper A's (III-A)."""
