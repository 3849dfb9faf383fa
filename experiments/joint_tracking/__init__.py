"""``timberhand experiment joint-tracking``: compares the joint control laws on the same motions and disturbances."""
