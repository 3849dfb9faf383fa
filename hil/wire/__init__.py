"""The wire: a user-space CAN bus with arbitration, bit times, error states and faults."""
