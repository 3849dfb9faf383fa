"""Scenes: which logs there are, and how they come to rest."""
