"""The PLC path compared with the CAN path: same jobs, seeds and machines."""
