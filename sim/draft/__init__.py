"""Drafts what the plant needs of a machine of one's own: its truth, and its steel as URDF."""
