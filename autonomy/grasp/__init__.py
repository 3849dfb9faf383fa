"""Grasp planning: which logs to grip, how the open grapple comes down on them, and where they are laid."""
