"""What the machine is: its profile, geometry, sensors, modes and reasons."""
