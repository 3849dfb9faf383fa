"""``timberhand experiment joint-tracking``: the joint laws beside each other on the same motions and disturbances."""
