"""From a mask and its depth to a cylinder with its covariance."""
