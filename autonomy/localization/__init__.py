"""Position and attitude of the machine from the controller's vehicle reports."""
