"""The timberhand command."""
