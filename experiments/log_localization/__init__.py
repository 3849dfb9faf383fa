"""Where is the log? Paper B's test of its vision (4.1.3, 5.1.2), with its own pipeline and ours on the same frames."""
