"""The fault campaign: every entry of the fault catalogue injected at random moments, and nominal work without faults."""
