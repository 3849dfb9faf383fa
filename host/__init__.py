"""What timberhand needs from the host computer: exit codes, systemd, doctor, labs."""
