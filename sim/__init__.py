"""The plant: a physics simulation of the machine on the other side of the bus.  Entry point: ``sim.plant.Plant``."""
