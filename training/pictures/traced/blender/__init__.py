"""The process that draws: it runs in Blender's own Python environment and imports nothing of this project but data."""
