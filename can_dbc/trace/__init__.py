"""CAN traces for people: text traces in, decoded frames out."""
