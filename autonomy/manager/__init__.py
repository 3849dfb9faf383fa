"""The activity manager: what the forwarder does next, as a table, and what it needs to know to decide."""
