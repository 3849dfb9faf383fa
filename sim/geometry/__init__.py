"""Boxes, rotations and the local frame on the Earth: pure geometry that every part of the plant shares."""
