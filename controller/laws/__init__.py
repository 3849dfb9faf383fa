"""Control laws of joints and grapple: pure, per second, no clock.

``feedback`` says how an error becomes a velocity (PD, PID, sliding mode, super-twisting); ``joint`` puts one of them
into the shell that all share: feed-forward, delay compensation, pressure damping, limits; ``rest`` ends a motion;
``crane`` slows all joints together and ``pace`` the trajectory.
"""
