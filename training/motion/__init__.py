"""Demonstrated motions in recordings, from which movement primitives are learned."""
