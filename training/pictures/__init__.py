"""Labelled pictures of logs: drawn from settled piles and kept in shards, or read from COCO data sets."""
