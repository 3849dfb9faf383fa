"""Missions of a forwarder: reading and writing the formats people plan with, validation, and the forwarding report."""
