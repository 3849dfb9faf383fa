"""The crane-accuracy experiment: paper B's test of the crane (4.1.2, 5.1.3) on calibrated individual machines."""
