"""The one-log job, in lockstep and live."""
