"""Commissioning a machine: the step of one joint with its response, and the acceptance protocol."""
