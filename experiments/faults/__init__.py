"""The fault campaign: every entry of the fault catalogue at random moments, and work without faults."""
