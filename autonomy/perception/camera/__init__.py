"""One camera: its RGB-D frames, its mount on the machine, the survey of that mount."""
