"""The status of the systemd services and of the controller's timing."""
