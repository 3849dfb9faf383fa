"""The plant's cameras: an analytic RGB-D renderer, a stereo noise model, labels, and the cameras on the machine."""
