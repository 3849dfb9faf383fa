"""Navigation: paper B's way and ours along four waypoints, on the machine on the bus."""
