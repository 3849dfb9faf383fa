"""How the machine drives along waypoints: paper B's way and our own."""
