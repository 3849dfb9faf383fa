"""The navigation experiment: paper B's law and our path follower along four waypoints, with the whole machine."""
