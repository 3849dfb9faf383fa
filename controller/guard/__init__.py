"""The guard: a second, independent opinion on the traffic of crane0.  Standard library alone; see `judge`."""
