"""What perception reports: log observations, their covariance, their datagrams."""
