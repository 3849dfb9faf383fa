"""``timberhand experiment plant``: does the simulated machine behave like steel, oil and wood?"""
