"""The emulated machine PLC: between Ethernet and the valves on a machine like paper A's (III-A)."""
