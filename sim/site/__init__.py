"""The site of a mission: where the logs lie, and how collected ones are replaced."""
