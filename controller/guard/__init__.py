"""The guard: an independent check of the traffic on crane0, with its own decoding of the DBC."""
