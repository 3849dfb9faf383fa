"""Control laws of joints, grapple and carrier: pure, limits per second, no clock.

`feedback` turns an error into a velocity (PD, PID, sliding mode, super-twisting).  `joint` puts one of them into a
common structure: feed-forward, delay compensation, pressure feedback, limits; `end_positioning` ends a motion.  `crane`
scales all joints by one factor, `time_scaling` the trajectory's time, and `valve_map` compensates dead-band and
metering curve.
"""
