"""The machine's mechanics: crane, grapple, column, carrier and the hand levers."""
