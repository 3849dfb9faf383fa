"""The plant experiment: does the simulated machine behave like steel, oil and wood?"""
