"""The forwarding-mission experiment: paper B's complete task by both methods, and many more missions with ours."""
