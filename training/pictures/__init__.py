"""Labelled pictures of logs, drawn from settled piles and kept in shards."""
