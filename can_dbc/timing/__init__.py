"""Timing of the control loop: histograms of durations and the page in shared memory that shows them."""
