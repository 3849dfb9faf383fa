"""Protocols on top of CAN frames: CANopen, NMEA 2000 and end-to-end protection."""
