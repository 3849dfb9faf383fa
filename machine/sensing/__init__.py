"""From sensor values to physical quantities: encoder counts and the load on the lift cylinder."""
