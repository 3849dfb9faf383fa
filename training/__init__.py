"""Training of the networks and collection of demonstrations; nothing here runs on a machine."""
