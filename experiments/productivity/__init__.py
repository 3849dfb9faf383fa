"""The productivity experiment: wood per hour from single logs and piles, and unloading at a landing."""
