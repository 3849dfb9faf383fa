"""Views of the plant: its cameras, still pictures, a live page."""
