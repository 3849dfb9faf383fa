"""Logs: their shape, their rigid bodies, how they are stacked, and the bunk that carries them."""
