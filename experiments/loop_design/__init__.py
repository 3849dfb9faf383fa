"""Loop design: linear model of each joint, and its margins over all machines of the truth's spread."""
