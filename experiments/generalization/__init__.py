"""A world that the software has never seen: truths at their ends and drawn at once, calibration and grasps."""
