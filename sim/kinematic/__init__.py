"""A machine without physics: every joint moves exactly as its valve's characteristic says."""
