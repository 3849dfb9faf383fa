"""Demonstrations of crane motions by an emulated operator at the hand levers."""
