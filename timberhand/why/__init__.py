"""Why the machine stopped: finds the stops of a run, explains them, and draws them."""
