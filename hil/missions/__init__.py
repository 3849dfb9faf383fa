"""Whole forwarding missions, in lockstep and live."""
