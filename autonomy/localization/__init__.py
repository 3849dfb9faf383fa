"""Where the machine is and which way it faces, from what the controller reports of a machine that drives."""
