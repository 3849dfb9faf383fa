"""Experiments: repeatable commands that measure, compare with limits, and write result.json, plots and a page."""
