"""The shell around `step`: real-time loop, buses, timing, tick records and the warm-up."""
