"""Experiments: repeatable commands that measure, judge against a limit, and write result.json, plots and docs."""
