"""The operator's web page: a server that shows crane, vehicle and mission, and sends operator commands."""
