"""Logs over time: data association and one filter for each log."""
