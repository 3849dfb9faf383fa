"""Writes recordings: MCAP files of frames, reports and messages, with a manifest."""
