"""The contract on the bus and between processes: CAN frames, buses, DBC codecs, protocols and messages."""
