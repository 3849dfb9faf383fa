"""Benchmarks of single functions, without trials and limits."""
