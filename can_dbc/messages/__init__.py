"""Messages between processes that do not travel on CAN: datagrams, tick records and camera frames."""
