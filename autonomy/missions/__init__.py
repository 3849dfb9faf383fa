"""What a forwarder is to do: missions from the formats people plan with, checked, and what was forwarded, reported."""
