"""The grasp-network experiment: parameters, two cross-validations on Cornell data, and latency."""
