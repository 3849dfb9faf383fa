"""Training of paper A's grasp network: Cornell rectangles and physical labels."""
