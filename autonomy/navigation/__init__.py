"""Driving: along a planned path with path following (ours), or from waypoint to waypoint (paper B)."""
