"""Fault injection: faults by name in PX4's words, orders for a moment of a run, and how they reach each edge."""
