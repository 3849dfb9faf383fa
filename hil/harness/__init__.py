"""The two harnesses, lockstep and live, with the emulated operator and the terminal view."""
