"""Loop design that can be checked: each joint's linear model, its margins over all machines of the truth's spread."""
