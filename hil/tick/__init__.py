"""Runs the same ticks on the interpreter and on the compiled tick, to compare their bytes and their cost."""
