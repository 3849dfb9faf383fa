"""The plant: a physics stand-in for the machine on the far side of the bus.  Start at ``sim.plant.Plant``."""
