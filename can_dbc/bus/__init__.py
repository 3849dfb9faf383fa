"""CAN buses behind one small interface: the wire, SocketCAN and every python-can adapter."""
