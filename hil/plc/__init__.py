"""The emulated PLC path between crane0 and the plant."""
