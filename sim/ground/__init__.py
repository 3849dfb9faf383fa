"""The ground: its surface, and the tyres that roll on it."""
