"""Geometry of crane, column, grapple, carrier and cameras."""
