"""The log-localization experiment: paper B's test of its vision (4.1.3, 5.1.2), its pipeline and ours compared."""
