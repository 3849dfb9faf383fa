"""Paper A's grasp network: its parameters, two cross-validations on Cornell data, and what a picture costs."""
