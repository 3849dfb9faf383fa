"""Crane motion planning: kinematics with limits, time laws, collision-free paths, movement primitives, setpoints."""
